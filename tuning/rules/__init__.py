"""Tuning rules, one family a file. A rule is `rule(model, *, option=...) -> Setting`.

`tuning.rules.registry` lists them all.
"""
