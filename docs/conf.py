"""The documents as a site: make docs, then open build/docs/index.html."""

project = "Loopwright"
extensions = ["myst_parser"]
exclude_patterns = ["notebooks"]
myst_heading_anchors = 4
html_theme = "alabaster"
html_theme_options = {"description": "Retuning of PI and PID loops", "page_width": "1080px", "fixed_sidebar": True}
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}
html_copy_source = False
html_extra_path = ["notebooks"]
