"""Attempts to break the suite: ``python -m benchmarks.faults``.

A row of the table is a :class:`benchmarks.faults.measure.Row`: a name, how many trials, and a function that makes
them and says what went wrong in each. Whatever is random in a trial follows from the seed, the row and the number of
the trial, so that a single one can be repeated. A new row is one module and one line in ``rows.py``.
"""
