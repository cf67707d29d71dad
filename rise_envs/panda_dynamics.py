"""Mass matrices and bias forces of many Panda arms at once, in the lanes of :mod:`rise_envs.panda_lanes`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rise_envs.panda_lanes import LANES, ONE, REAL, ZERO, Lanes, N, fixed, lane

Array = NDArray[np.float64]

_DAMPING = REAL(0.04)  # Bullet's, of every body
_GRAVITY = REAL(9.81)
_HALF = np.sqrt(0.5)


def _inertias() -> tuple[Array, Array, Array]:
    """Masses (7,), centres of mass (7, 3) and inertias about them (7, 3, 3) of the moving bodies, in their frames.

    Masses and centres are the URDF's; Bullet computes the inertias from the collision shapes. Hand and fingers
    belong to body 7.
    """
    mass = np.array([2.7, 2.73, 2.04, 2.08, 3.0, 1.3, 0.2])
    center = np.array(
        [
            [0.0, -0.04, -0.05],
            [0.0, -0.04, 0.06],
            [0.01, 0.01, -0.05],
            [-0.03, 0.03, 0.02],
            [0.0, 0.04, -0.12],
            [0.04, 0.0, 0.0],
            [0.0, 0.0, 0.08],
        ]
    )
    diagonal = np.array(
        [
            [0.022971310, 0.017768771, 0.011484088],
            [0.023490852, 0.011612936, 0.018228195],
            [0.010920469, 0.012580505, 0.011968103],
            [0.011335035, 0.012248637, 0.013056772],
            [0.035676471, 0.029848038, 0.012802225],
            [0.003427982, 0.005116922, 0.005987757],
            [0.000361607, 0.000362157, 0.000592108],
        ]
    )
    inertia = diagonal[:, :, None] * np.eye(3)
    hand_axes = np.array([[_HALF, _HALF, 0.0], [-_HALF, _HALF, 0.0], [0.0, 0.0, 1.0]])  # in frame 7
    finger = np.array([4.168136569e-5, 3.873779772e-5, 1.693540219e-5])
    parts = [
        (0.2, center[6].copy(), inertia[6].copy()),
        (
            0.81,
            np.array([0.0, 0.0, 0.147]),
            hand_axes @ np.diag([0.003719113, 0.001016160, 0.003388322]) @ hand_axes.T,
        ),
    ]
    for side in (0.01, -0.01):
        at = np.array([0.0, 0.0, 0.107]) + hand_axes @ np.array([0.0, side, 0.0784])
        parts.append((0.1, at, hand_axes @ np.diag(finger) @ hand_axes.T))
    mass[6] = sum(part[0] for part in parts)
    center[6] = sum(part[0] * part[1] for part in parts) / mass[6]
    inertia[6] = 0.0
    for weight, at, own in parts:
        off = at - center[6]
        inertia[6] += own + weight * (off @ off * np.eye(3) - np.outer(off, off))
    return mass, center, inertia


_MASS, _CENTER, _INERTIA = (part.astype(REAL) for part in _inertias())


@lane
def write_bodies(axes: Lanes, origin: Lanes, speed: Lanes, spatial: Lanes, body: Lanes, twist: Lanes) -> None:
    """Inertias of the bodies and the forces that their motion at constant joint speeds takes, in place.

    Recursive Newton-Euler (Featherstone, "Rigid Body Dynamics Algorithms", 2008), all about the world's origin;
    gravity is an upward acceleration of the base, and Bullet's damping of bodies is added.
    """
    axes, origin = fixed(axes, (N + 1, 3, 3, LANES)), fixed(origin, (N + 1, 3, LANES))
    speed, spatial = fixed(speed, (N, LANES)), fixed(spatial, (12, LANES))
    body, twist = fixed(body, (N, 15, LANES)), fixed(twist, (N, 6, LANES))
    for r in range(12):
        for m in range(LANES):
            spatial[r, m] = _GRAVITY if r == 11 else ZERO
    for k in range(N):
        mass = _MASS[k]
        c0, c1, c2 = _CENTER[k, 0], _CENTER[k, 1], _CENTER[k, 2]
        i00, i11, i22 = _INERTIA[k, 0, 0], _INERTIA[k, 1, 1], _INERTIA[k, 2, 2]
        i01, i02, i12 = _INERTIA[k, 0, 1], _INERTIA[k, 0, 2], _INERTIA[k, 1, 2]
        for m in range(LANES):
            a0, a1, a2 = axes[k + 1, 0, 0, m], axes[k + 1, 1, 0, m], axes[k + 1, 2, 0, m]
            b0, b1, b2 = axes[k + 1, 0, 1, m], axes[k + 1, 1, 1, m], axes[k + 1, 2, 1, m]
            z0, z1, z2 = axes[k + 1, 0, 2, m], axes[k + 1, 1, 2, m], axes[k + 1, 2, 2, m]
            p0, p1, p2 = origin[k + 1, 0, m], origin[k + 1, 1, m], origin[k + 1, 2, m]
            x0, x1, x2 = (
                p0 + a0 * c0 + b0 * c1 + z0 * c2,
                p1 + a1 * c0 + b1 * c1 + z1 * c2,
                p2 + a2 * c0 + b2 * c1 + z2 * c2,
            )
            # Spatial axis of the joint, velocity and acceleration of the body.
            u0, u1, u2 = p1 * z2 - p2 * z1, p2 * z0 - p0 * z2, p0 * z1 - p1 * z0
            rate = speed[k, m]
            w0, w1, w2 = spatial[0, m] + z0 * rate, spatial[1, m] + z1 * rate, spatial[2, m] + z2 * rate
            v0, v1, v2 = spatial[3, m] + u0 * rate, spatial[4, m] + u1 * rate, spatial[5, m] + u2 * rate
            e0 = spatial[6, m] + rate * (w1 * z2 - w2 * z1)
            e1 = spatial[7, m] + rate * (w2 * z0 - w0 * z2)
            e2 = spatial[8, m] + rate * (w0 * z1 - w1 * z0)
            f0 = spatial[9, m] + rate * (w1 * u2 - w2 * u1 + v1 * z2 - v2 * z1)
            f1 = spatial[10, m] + rate * (w2 * u0 - w0 * u2 + v2 * z0 - v0 * z2)
            f2 = spatial[11, m] + rate * (w0 * u1 - w1 * u0 + v0 * z1 - v1 * z0)
            # Inertia about the centre of mass, world axes.
            s0, s1, s2 = (
                a0 * i00 + b0 * i01 + z0 * i02,
                a1 * i00 + b1 * i01 + z1 * i02,
                a2 * i00 + b2 * i01 + z2 * i02,
            )
            t0, t1, t2 = (
                a0 * i01 + b0 * i11 + z0 * i12,
                a1 * i01 + b1 * i11 + z1 * i12,
                a2 * i01 + b2 * i11 + z2 * i12,
            )
            q0, q1, q2 = (
                a0 * i02 + b0 * i12 + z0 * i22,
                a1 * i02 + b1 * i12 + z1 * i22,
                a2 * i02 + b2 * i12 + z2 * i22,
            )
            g00, g11, g22 = (
                s0 * a0 + t0 * b0 + q0 * z0,
                s1 * a1 + t1 * b1 + q1 * z1,
                s2 * a2 + t2 * b2 + q2 * z2,
            )
            g01, g02, g12 = (
                s0 * a1 + t0 * b1 + q0 * z1,
                s0 * a2 + t0 * b2 + q0 * z2,
                s1 * a2 + t1 * b2 + q1 * z2,
            )
            # Damping, at the centre of mass.
            y0, y1, y2 = v0 + w1 * x2 - w2 * x1, v1 + w2 * x0 - w0 * x2, v2 + w0 * x1 - w1 * x0
            drag = mass * _DAMPING * (ONE + np.sqrt(y0 * y0 + y1 * y1 + y2 * y2))
            d0, d1, d2 = drag * y0, drag * y1, drag * y2
            drag = _DAMPING * (ONE + np.sqrt(w0 * w0 + w1 * w1 + w2 * w2))
            n0 = drag * (g00 * w0 + g01 * w1 + g02 * w2) + x1 * d2 - x2 * d1
            n1 = drag * (g01 * w0 + g11 * w1 + g12 * w2) + x2 * d0 - x0 * d2
            n2 = drag * (g02 * w0 + g12 * w1 + g22 * w2) + x0 * d1 - x1 * d0
            # Inertia about the world's origin, momentum, force.
            h0, h1, h2 = mass * x0, mass * x1, mass * x2
            g00, g11, g22 = g00 + h1 * x1 + h2 * x2, g11 + h0 * x0 + h2 * x2, g22 + h0 * x0 + h1 * x1
            g01, g02, g12 = g01 - h0 * x1, g02 - h0 * x2, g12 - h1 * x2
            l0 = g00 * w0 + g01 * w1 + g02 * w2 + h1 * v2 - h2 * v1
            l1 = g01 * w0 + g11 * w1 + g12 * w2 + h2 * v0 - h0 * v2
            l2 = g02 * w0 + g12 * w1 + g22 * w2 + h0 * v1 - h1 * v0
            m0, m1, m2 = (
                mass * v0 + w1 * h2 - w2 * h1,
                mass * v1 + w2 * h0 - w0 * h2,
                mass * v2 + w0 * h1 - w1 * h0,
            )
            n0 += g00 * e0 + g01 * e1 + g02 * e2 + h1 * f2 - h2 * f1 + w1 * l2 - w2 * l1 + v1 * m2 - v2 * m1
            n1 += g01 * e0 + g11 * e1 + g12 * e2 + h2 * f0 - h0 * f2 + w2 * l0 - w0 * l2 + v2 * m0 - v0 * m2
            n2 += g02 * e0 + g12 * e1 + g22 * e2 + h0 * f1 - h1 * f0 + w0 * l1 - w1 * l0 + v0 * m1 - v1 * m0
            d0 += mass * f0 + e1 * h2 - e2 * h1 + w1 * m2 - w2 * m1
            d1 += mass * f1 + e2 * h0 - e0 * h2 + w2 * m0 - w0 * m2
            d2 += mass * f2 + e0 * h1 - e1 * h0 + w0 * m1 - w1 * m0
            spatial[0, m], spatial[1, m], spatial[2, m] = w0, w1, w2
            spatial[3, m], spatial[4, m], spatial[5, m] = v0, v1, v2
            spatial[6, m], spatial[7, m], spatial[8, m] = e0, e1, e2
            spatial[9, m], spatial[10, m], spatial[11, m] = f0, f1, f2
            twist[k, 0, m], twist[k, 1, m], twist[k, 2, m] = z0, z1, z2
            twist[k, 3, m], twist[k, 4, m], twist[k, 5, m] = u0, u1, u2
            body[k, 0, m], body[k, 1, m], body[k, 2, m] = g00, g11, g22
            body[k, 3, m], body[k, 4, m], body[k, 5, m] = g01, g02, g12
            body[k, 6, m], body[k, 7, m], body[k, 8, m] = h0, h1, h2
            body[k, 9, m], body[k, 10, m], body[k, 11, m] = n0, n1, n2
            body[k, 12, m], body[k, 13, m], body[k, 14, m] = d0, d1, d2


@lane
def write_dynamics(twist: Lanes, body: Lanes, force: Lanes, matrix: Lanes, torque: Lanes) -> None:
    """Mass matrices (7, 7, L), lower triangle, and −bias torques (7, L): composite bodies, from the hand backwards.

    Args:
        twist: of `write_bodies`.
        body: of `write_bodies`; receives the sums from each body to the hand.
        force: scratch, (12, L).
        matrix: receives the mass matrices.
        torque: receives minus the torques that gravity and motion at constant joint speeds take (N m).
    """
    twist, body, force = fixed(twist, (N, 6, LANES)), fixed(body, (N, 15, LANES)), fixed(force, (12, LANES))
    matrix, torque = fixed(matrix, (N, N, LANES)), fixed(torque, (N, LANES))
    for r in range(15):
        for m in range(LANES):
            total = body[N - 1, r, m]
            for back in range(2, N + 1):
                total += body[N - back, r, m]
                body[N - back, r, m] = total
    mass = ZERO
    for j in range(N - 1, -1, -1):
        mass += _MASS[j]
        for m in range(LANES):
            z0, z1, z2 = twist[j, 0, m], twist[j, 1, m], twist[j, 2, m]
            u0, u1, u2 = twist[j, 3, m], twist[j, 4, m], twist[j, 5, m]
            g01, g02, g12 = body[j, 3, m], body[j, 4, m], body[j, 5, m]
            h0, h1, h2 = body[j, 6, m], body[j, 7, m], body[j, 8, m]
            force[0, m] = body[j, 0, m] * z0 + g01 * z1 + g02 * z2 + h1 * u2 - h2 * u1
            force[1, m] = g01 * z0 + body[j, 1, m] * z1 + g12 * z2 + h2 * u0 - h0 * u2
            force[2, m] = g02 * z0 + g12 * z1 + body[j, 2, m] * z2 + h0 * u1 - h1 * u0
            force[3, m] = mass * u0 + z1 * h2 - z2 * h1
            force[4, m] = mass * u1 + z2 * h0 - z0 * h2
            force[5, m] = mass * u2 + z0 * h1 - z1 * h0
        for i in range(j + 1):
            for m in range(LANES):
                matrix[j, i, m] = (
                    force[0, m] * twist[i, 0, m]
                    + force[1, m] * twist[i, 1, m]
                    + force[2, m] * twist[i, 2, m]
                    + force[3, m] * twist[i, 3, m]
                    + force[4, m] * twist[i, 4, m]
                    + force[5, m] * twist[i, 5, m]
                )
        for m in range(LANES):
            total = ZERO
            for r in range(6):
                total -= twist[j, r, m] * body[j, 9 + r, m]
            torque[j, m] = total


@lane
def write_product(matrix: Lanes, x: Lanes, y: Lanes) -> None:
    """Products ``y`` = matrix · x, (7, L)."""
    matrix, x, y = fixed(matrix, (N, N, LANES)), fixed(x, (N, LANES)), fixed(y, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            total = matrix[i, 0, m] * x[0, m]
            for j in range(1, N):
                total += matrix[i, j, m] * x[j, m]
            y[i, m] = total
