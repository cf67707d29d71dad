"""Hand-made episodes for tests of tables."""

import numpy as np

from benchmarks import results


def make_rows(n=6, start=0, **changes):
    """``n`` episodes, one in three unsafe, the last not arrived."""
    scenario = np.arange(start, start + n)
    safe, arrived = scenario % 3 != 0, scenario < start + n - 1
    columns = {
        "env": "RISE-GroundVehicle-v0",
        "agent": "rise",
        "train_seed": 0,
        "noise_model": "step",
        "noise_level": 1.0,
        "scenario": scenario,
        "env_seed": scenario + 2**40,
        "noise_seed": scenario + 2**41,
        "safe": safe,
        "arrived": arrived,
        "steps": 100 + scenario,
        "episode_cost": np.where(safe, 0.0, 2.0),
        "min_clearance": np.where(safe, 0.1, -0.1),
        "episode_return": scenario / 3,
    } | changes
    return results.from_columns({"reached": np.logical_and(columns["safe"], columns["arrived"])} | columns)
