"""The only file that touches the physics engine: panda-gym's arm on its table, and the arm's clearance.

Engine, robot, scaling, inverse kinematics, motors and the 20 substeps of 2 ms are panda-gym's own, so that
the hand moves exactly as in ``PandaReach-v3``. What differs is around them: calls go straight to the engine
instead of through panda-gym's wrappers, and the start-up chatter on standard output is silenced.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

N_SUBSTEPS = 20
SUBSTEP = 0.002  # s
STEP_SCALE = 0.05  # m of commanded hand displacement per unit of action
HAND_LINK = 11  # the point between the finger tips, panda-gym's end effector
NO_LINK = -2
_HAND_DOWN = (1.0, 0.0, 0.0, 0.0)
_PROBE_RADIUS = 0.001  # m

# When the clearance is looked at within a step: as soon as it could have fallen below _CLOSE since the last look,
# but no more often than every few substeps, and more often near contact. Against a look after every substep, the
# least clearance then errs by less than 1 mm below _CLOSE (by 0.02 m beyond it and in the midst of a collision),
# and a contact is never missed.
_CLOSE = 0.04  # m
_ARM_SPEED = 3.2  # m/s; the wildest actions brought no part of the arm nearer to a point at 2.9 m/s
_LOOK_EVERY = 4  # substeps; twice as many once the arm draws away
_NEAR = 0.005  # m; nearer than this after every substep, every second one once the arm draws away
_SLACK = 0.01  # m that the look at the end reaches beyond where the arm should be, before it looks everywhere

Point = tuple[float, float, float]
Nearest = tuple[float, int]  # signed clearance (m) and the index of the link that has it


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Send what is written to the file descriptors 1 and 2 meanwhile, by C code too, to nowhere."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    sys.stderr.flush()
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
            # No ground below the table: nothing gets there, and the engine would look for contacts all the time.
            self._engine.create_table(length=1.1, width=0.7, height=0.4, x_offset=-0.3)
        self._bullet = pybullet
        self._client: int = self._engine.physics_client._client
        self._arm: int = self._engine._bodies_idx[robot.body_name]
        self._table: int = self._engine._bodies_idx["table"]
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

    def state(self) -> Array:
        """Position (m) and velocity (m/s) of the hand as panda-gym reports them, then the 7 joint angles, (13,)."""
        joints = self._bullet.getJointStates(self._arm, self._joints[:7], physicsClientId=self._client)
        return np.array((*self._position, *self._velocity, *[joint[0] for joint in joints]))

    @property
    def hand(self) -> tuple[float, ...]:
        """Position of the hand (m), as in `state`, (3,)."""
        return self._position

    def _read_hand(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        state = self._bullet.getLinkState(
            self._arm, HAND_LINK, computeLinkVelocity=True, physicsClientId=self._client
        )
        return state[0], state[6]

    def clearance(self, center: ArrayLike, radius: float, within: float = 10.0) -> Nearest:
        """Signed distance between the arm's surface and a sphere, and the nearest link.

        Args:
            center: centre of the sphere (m), (3,).
            radius: its radius (m).
            within: distances beyond this (m) are not looked for, which is cheaper.

        Returns:
            The least distance over all links (m), negative in collision, and the index of the link that has
            it; (inf, NO_LINK) if there is none ``within``.
        """
        points = self._bullet.getClosestPoints(
            bodyA=self._arm,
            bodyB=-1,
            distance=max(within + radius - _PROBE_RADIUS, 0.0),
            collisionShapeB=self._probe,
            collisionShapePositionB=center,
            physicsClientId=self._client,
        )
        distance, link = min(((point[8], point[3]) for point in points), default=(np.inf, NO_LINK))
        distance -= radius - _PROBE_RADIUS
        # Deep in a collision the engine knows no bound and may have found more than was asked for.
        return (distance, link) if distance <= within else (np.inf, NO_LINK)

    def step(
        self, action: NDArray[np.float32], center: Point, velocity: Point, radius: float, start: Nearest
    ) -> tuple[Nearest, Nearest]:
        """Move the hand by ``action`` for one control step while a sphere passes through the scene.

        Args:
            action: displacement of the hand in units of ``STEP_SCALE``, (3,), float32 as in panda-gym.
            center: centre of the sphere (m) as the step begins, (3,).
            velocity: its velocity during the step (m/s), (3,).
            radius: its radius (m).
            start: the clearance as the step begins.

        Returns:
            The least clearance over the step, both ends included, and the clearance at its end.
        """
        self._command(action)
        (x, y, z), (u, v, w) = center, velocity
        least, advance, client = start, self._bullet.stepSimulation, self._client
        nearing = SUBSTEP * (_ARM_SPEED + abs(u) + abs(v) + abs(w))  # m per substep, at most
        due = max(_LOOK_EVERY, int((least[0] - _CLOSE) / nearing)) if least[0] > -_NEAR else N_SUBSTEPS
        away = due >= N_SUBSTEPS
        for substep in range(1, N_SUBSTEPS):
            advance(client)
            near = -_NEAR < least[0] < _NEAR
            if substep >= due or (near and not away):
                # Only what comes nearer than before matters: the rest the engine rules out at little cost.
                t = substep * SUBSTEP
                now = self.clearance((x + t * u, y + t * v, z + t * w), radius, within=least[0])
                away = now > least
                least = min(least, now)
                pause = (_LOOK_EVERY // 2 if near else 2 * _LOOK_EVERY) if away else _LOOK_EVERY
                due = substep + max(pause, int((least[0] - _CLOSE) / nearing))
        advance(client)
        before = self._position
        self._position, self._velocity = self._read_hand()
        t = N_SUBSTEPS * SUBSTEP
        last = (x + t * u, y + t * v, z + t * w)
        moved = math.dist(before, self._position) if away else 0.0
        end = self.clearance(last, radius, within=least[0] + moved + _SLACK)
        if end[1] == NO_LINK:
            end = self.clearance(last, radius)
        return min(least, end), end

    def _command(self, action: NDArray[np.float32]) -> None:
        """Set the motors for a displacement of the hand, exactly as panda-gym's robot does."""
        # The product in float32, the sum in float64: so the target is panda-gym's to the last bit.
        dx, dy, dz = (action * STEP_SCALE).tolist()
        x, y, z = self._position
        target = (x + dx, y + dy, max(0.0, z + dz))
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

    def photograph(
        self, view: Array, projection: Array, width: int, height: int, light: Array
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
        """Arm and table as a camera sees them.

        Args:
            view: OpenGL's view matrix, (4, 4).
            projection: OpenGL's projection matrix, (4, 4).
            width: of the picture (px).
            height: of the picture (px).
            light: direction that the light comes from, (3,).

        Returns:
            Colours (H, W, 3), OpenGL's depth buffer (H, W), and where arm or table are seen (H, W).
        """
        _, _, colour, depth, body = self._bullet.getCameraImage(
            width,
            height,
            viewMatrix=view.T.ravel().tolist(),  # OpenGL stores columns
            projectionMatrix=projection.T.ravel().tolist(),
            lightDirection=light.tolist(),
            lightAmbientCoeff=0.6,
            lightDiffuseCoeff=0.42,
            lightSpecularCoeff=0.05,
            shadow=0,
            renderer=self._bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        # Engines built without NumPy hand out flat tuples.
        body = np.reshape(body, (height, width))
        colour = np.reshape(np.asarray(colour, np.uint8), (height, width, 4))[..., :3]
        return colour, np.reshape(depth, (height, width)), (body == self._arm) | (body == self._table)

    def close(self) -> None:
        """Free the engine. May be called again."""
        self._engine.close()
