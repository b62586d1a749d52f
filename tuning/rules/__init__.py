"""Tuning rules, one family a file. A rule is `rule(model, *, option=...) -> Setting`.

`tuning.methods` lists them all.
"""
