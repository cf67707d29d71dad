"""Speed, measured against the peers: ``python -m benchmarks.speed``.

A row of the table is a :class:`benchmarks.speed.measure.Row`: a name, a target and a function that sets up two
sides, ours and the peer's. The two take turns in one process, so that whatever else the machine does meets both.
A new row is one function and one line in ``rows.py``.
"""
