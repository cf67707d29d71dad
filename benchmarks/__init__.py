"""The benchmark: one command that trains agents, runs scenarios, and turns one row per episode into results.

Every table, figure and page is a pure function of those rows: rows (``results``) → rates and differences
with intervals (``tables``, by ``stats``) → figures (``plots``) and text (``report``).
"""
