"""Recorded tests as control systems, historians and spreadsheets write them, read into evenly spaced samples."""
