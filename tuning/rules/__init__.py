"""The tuning rules, one family in each file. A rule is a function `rule(model, *, option=...) -> Setting`.

`tuning.rules.registry` lists all of them.
"""
