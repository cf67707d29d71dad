"""The only file that touches the physics engine: panda-gym's arm on its table, and the arm's clearance.

Engine, robot, scaling, inverse kinematics, motors and the 20 substeps of 2 ms are panda-gym's own, so that
the hand moves exactly as in ``PandaReach-v3``. What differs is around them: calls go straight to the engine
instead of through panda-gym's wrappers, and the start-up chatter on standard output is silenced.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_SUBSTEPS = 20
SUBSTEP = 0.002  # s
STEP_SCALE = 0.05  # m of commanded hand displacement per unit of action
HAND_LINK = 11  # the point between the finger tips, panda-gym's end effector
_HAND_DOWN = (1.0, 0.0, 0.0, 0.0)
_PROBE_RADIUS = 0.001  # m


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Send what is written to the file descriptors 1 and 2 meanwhile, by C code too, to nowhere."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    libc.fflush(None)
    saved, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        # C holds back what it prints into a pipe: let it go before the real descriptors return.
        libc.fflush(None)
        for descriptor, original in zip((1, 2), saved, strict=True):
            os.dup2(original, descriptor)
            os.close(original)
        os.close(nowhere)


class PandaSim:
    """One Panda arm in its own engine instance, controlled by displacements of the hand.

    Args:
        visuals: load what only drawing needs (link meshes), too.
    """

    def __init__(self, visuals: bool = False) -> None:
        with silence():
            import pybullet
            from panda_gym.envs.robots.panda import Panda
            from panda_gym.pybullet import PyBullet

            class Engine(PyBullet):
                def loadURDF(self, body_name: str, **kwargs: Any) -> None:
                    flags = 0 if visuals else pybullet.URDF_IGNORE_VISUAL_SHAPES
                    super().loadURDF(body_name, flags=flags, **kwargs)

            self._engine = Engine(render_mode="rgb_array", n_substeps=N_SUBSTEPS, renderer="Tiny")
            robot = Panda(self._engine, block_gripper=True, base_position=np.array([-0.6, 0.0, 0.0]))
            self._engine.create_plane(z_offset=-0.4)
            self._engine.create_table(length=1.1, width=0.7, height=0.4, x_offset=-0.3)
        self._bullet = pybullet
        self._client: int = self._engine.physics_client._client
        self._arm: int = self._engine._bodies_idx[robot.body_name]
        self._neutral: list[float] = robot.neutral_joint_values.tolist()
        self._joints: list[int] = robot.joint_indices.tolist()
        self._forces: list[float] = robot.joint_forces.tolist()
        self._probe: int = pybullet.createCollisionShape(
            pybullet.GEOM_SPHERE, radius=_PROBE_RADIUS, physicsClientId=self._client
        )
        # Contacts of the arm with the table are solved in a fixed order, whatever was touched before.
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=self._client)
        self.link_names: dict[int, str] = {-1: "panda_link0"}
        for joint in range(pybullet.getNumJoints(self._arm, physicsClientId=self._client)):
            joint_info = pybullet.getJointInfo(self._arm, joint, physicsClientId=self._client)
            self.link_names[joint] = joint_info[12].decode()
        self.reset()

    def reset(self) -> None:
        """Bring the arm to rest in panda-gym's neutral pose."""
        for joint, angle in zip(self._joints, self._neutral, strict=True):
            self._bullet.resetJointState(self._arm, joint, angle, physicsClientId=self._client)
        self._position, self._velocity = self._read_hand()

    @property
    def hand(self) -> tuple[Array, Array]:
        """Position (m) and velocity (m/s) of the hand as panda-gym reports them, (3,) each."""
        return np.array(self._position), np.array(self._velocity)

    @property
    def joint_angles(self) -> Array:
        """Angles of the seven arm joints (rad), (7,)."""
        states = self._bullet.getJointStates(self._arm, self._joints[:7], physicsClientId=self._client)
        return np.array([state[0] for state in states])

    def _read_hand(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        state = self._bullet.getLinkState(
            self._arm, HAND_LINK, computeLinkVelocity=True, physicsClientId=self._client
        )
        return state[0], state[6]

    def clearance(self, center: Array, radius: float, within: float = 10.0) -> tuple[float, int]:
        """Signed distance (m) between the arm's surface and a sphere, and the index of the nearest link.

        Args:
            center: centre of the sphere (m), (3,).
            radius: its radius (m).
            within: distances beyond this (m) are not looked for, which is cheaper.

        Returns:
            The least distance over all links, negative in collision; (inf, -2) if it exceeds ``within``.
        """
        points = self._bullet.getClosestPoints(
            bodyA=self._arm,
            bodyB=-1,
            distance=within + radius - _PROBE_RADIUS,
            collisionShapeB=self._probe,
            collisionShapePositionB=center,
            physicsClientId=self._client,
        )
        if not points:
            return np.inf, -2
        distance, link = min((point[8], point[3]) for point in points)
        return distance - (radius - _PROBE_RADIUS), link

    def step(
        self, action: NDArray[np.float32], center: Array, velocity: Array, radius: float
    ) -> tuple[float, int]:
        """Move the hand by ``action`` for one control step while a sphere passes through the scene.

        Args:
            action: displacement of the hand in units of ``STEP_SCALE``, (3,), float32 as in panda-gym.
            center: centre of the sphere (m) as the step begins, (3,).
            velocity: its velocity during the step (m/s), (3,).
            radius: its radius (m).

        Returns:
            The least clearance (m) over the step and the link that had it, as in `clearance`.
        """
        target = np.array(self._position) + action * STEP_SCALE
        target[2] = max(0.0, target[2])
        angles = self._bullet.calculateInverseKinematics(
            self._arm, HAND_LINK, target, _HAND_DOWN, physicsClientId=self._client
        )
        self._bullet.setJointMotorControlArray(
            self._arm,
            self._joints,
            self._bullet.POSITION_CONTROL,
            targetPositions=(*angles[:7], 0.0, 0.0),
            forces=self._forces,
            physicsClientId=self._client,
        )
        least = self.clearance(center, radius)
        for substep in range(1, N_SUBSTEPS + 1):
            self._bullet.stepSimulation(physicsClientId=self._client)
            if substep % 5 == 0:
                least = min(least, self.clearance(center + substep * SUBSTEP * velocity, radius))
        self._position, self._velocity = self._read_hand()
        return least

    def close(self) -> None:
        """Free the engine. May be called again."""
        self._engine.close()
