"""The operators' page in Debian's Chromium, against live processes; a package, so that its fixtures end with it."""
