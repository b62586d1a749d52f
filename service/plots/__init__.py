"""Pictures in files, without a display."""
