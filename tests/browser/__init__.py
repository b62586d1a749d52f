"""The operators' page in Debian's Chromium, against live processes; a package, so that its fixtures end with it."""

CHROMIUM = "chromium-headless-shell"
"""Chromium without its own windows: command and Debian package. With them (`chromium`), each page takes twice the
processor time."""
