"""The operators' page: files that a browser loads. The page is a client of the public API, and has no other one.

pages.py  sends the files
static/   the files: index.html, app.css, js/ (ours), vendor/ (others', written by tools/vendor_page.py)
"""
