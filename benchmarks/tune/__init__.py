"""Search for settings, with the same budget for each agent: ``python -m benchmarks.tune``.

Random search with successive halving (Jamieson and Talwalkar, AISTATS 2016), here with one halving: many settings are
trained once, the best quarter with more training seeds, each of which draws other demonstrations. Everything is judged
on validation scenarios, never on those of the benchmark.
"""
