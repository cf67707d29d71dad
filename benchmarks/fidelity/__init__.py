"""How far the kinematic Panda is from the engine: ``python -m benchmarks.fidelity``."""
