"""A trained agent as one ONNX file: frames, networks, units and bounds in a graph that runs without Python.

``python -m rise_agents.export CKPT --onnx`` writes it, and keeps it only if it acts as the agent does
(:mod:`.check`). :class:`rise_agents.onnx_policy.OnnxPolicy` acts by it, with the ``predict`` of every agent.
"""

from __future__ import annotations

import json
from typing import Any

from rise_agents import checkpoint
from rise_agents.agent import config_to_dict
from rise_agents.export.check import TOLERANCE, Differences, Sample, compare, sample
from rise_agents.export.trace import NotExportable
from rise_agents.files import StrPath, replacing

__all__ = ["NotExportable", "Sample", "export", "metadata", "sample"]


def export(agent: Any, path: StrPath, seen: Sample | None = None) -> Differences:
    """Write a trained agent as ONNX, if the file acts as the agent does.

    Args:
        agent: rise, pcbc, cppo or rise-belief.
        path: of the file, which appears only if it passed.
        seen: observations to compare on; by default 1,000 of noisy validation episodes.

    Returns:
        How far the file is from the agent, and from its networks in torch.

    Raises:
        ImportError: onnx or onnxruntime is not installed.
        NotExportable: the agent, or a setting of it, has no form in ONNX.
        ValueError: the file acts differently; an earlier one is intact.
        OSError: it cannot be written.
    """
    from rise_agents.export.graphs import build

    exported = build(agent)
    about = f"{agent.name} for {agent.env_id}, exported by rise-suite"
    content = exported.graph.serialised(metadata(agent, exported), about)
    seen = sample(agent) if seen is None else seen
    with replacing(path) as temporary:
        temporary.write_bytes(content)
        differences = compare(agent, temporary, seen)
        if not differences.largest <= TOLERANCE:  # NaN is no agreement
            raise ValueError(
                f"the exported {agent.name} differs from the agent by {differences.largest:.2g} of the actions' "
                f"half range, more than {TOLERANCE:g}: nothing is written"
            )
    return differences


def metadata(agent: Any, exported: Any) -> dict[str, str]:
    """What the file says of itself, as texts: JSON where it is more than a word."""
    graph = exported.graph
    config = config_to_dict(agent.config)

    def described(arrays: dict[str, Any]) -> str:
        return json.dumps(
            {
                name: {
                    "shape": ["batch", *array.shape[1:]],
                    "type": str(array.dtype),
                    "is": exported.about[name],
                }
                for name, array in arrays.items()
            }
        )

    return {
        "format": "1",
        "agent": agent.name,
        "env": agent.env_id,
        "seed": str(agent.seed),
        "settings": json.dumps(config, sort_keys=True),
        "versions": json.dumps(checkpoint.versions(), sort_keys=True),
        "evaluate_deterministic": json.dumps(agent.evaluate_deterministic),
        "draws": json.dumps({"size": exported.draws, "precision": exported.precision}),
        "state": json.dumps(exported.state),
        "inputs": described(graph.inputs),
        "outputs": described(graph.outputs),
    }
