"""Compiled loops over time of the cell engine: velocity Verlet, relaxation to rest, and a memory that forgets."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from zsdt.tignn.cell_kernel import _fast, internal_force


@_fast
@no_type_check
def advance(tables, memory, u, v, force, inverse_mass, steady, load, load_next, steps, dt, corner):
    """`steps` velocity-Verlet steps of `dt` [s]; changes u, v, force and memory, gives the work of the load [J].

    inverse_mass [nodes] 1/kg, zero where clamped; steady [nodes, 3] N: gravity and what else is constant;
    load -> load_next [nodes, 3] N linearly. Heat is gathered by the trapezoid of 2 W_viscous / tau.
    """
    nodes = force.shape[0]
    keep = math.exp(-dt / tables.tau)
    gain = (1.0 - keep) * tables.tau / dt
    work = 0.0
    for step in range(steps):
        s0, s1 = step / steps, (step + 1) / steps
        for c in range(memory.heat.shape[0]):
            memory.heat[c] += dt / tables.tau * memory.overstress[c]
        for n in range(nodes):
            for i in range(3):
                ext = load[n, i] + s0 * (load_next[n, i] - load[n, i])
                half = v[n, i] + 0.5 * dt * inverse_mass[n] * (force[n, i] + steady[n, i] + ext)
                v[n, i] = half
                move = dt * half
                u[n, i] += move
                work += move * (ext + 0.5 * (s1 - s0) * (load_next[n, i] - load[n, i]))
        internal_force(tables, memory, u, keep, gain, corner, force)
        for c in range(memory.heat.shape[0]):
            memory.heat[c] += dt / tables.tau * memory.overstress[c]
        for n in range(nodes):
            for i in range(3):
                ext = load[n, i] + s1 * (load_next[n, i] - load[n, i])
                v[n, i] += 0.5 * dt * inverse_mass[n] * (force[n, i] + steady[n, i] + ext)
    return work


@_fast
@no_type_check
def relax(tables, memory, u, force, inverse_mass, external, dt, steps, tolerance, corner):
    """Dynamic relaxation of the memory-free body to its equilibrium under `external` [nodes, 3] N; changes u.

    Critically damped for the slowest motion that is still there: its frequency is the Rayleigh quotient of the last
    step (Underwood). `dt` [s] must be stable. Gives the residual relative to the external force, and the steps taken.
    """
    nodes = force.shape[0]
    v, before = np.zeros((nodes, 3)), np.zeros((nodes, 3))
    scale, residual, damping = 1e-30, 1.0, 0.0
    for n in range(nodes):
        for i in range(3):
            if inverse_mass[n] > 0.0:
                scale += external[n, i] ** 2
    memory.history[:] = 0.0
    for step in range(steps):
        internal_force(tables, memory, u, 0.0, 0.0, corner, force)
        stiff, inertia, square = 0.0, 1e-300, 0.0
        for n in range(nodes):
            if inverse_mass[n] > 0.0:
                for i in range(3):
                    square += (force[n, i] + external[n, i]) ** 2
                    stiff -= dt * v[n, i] * (force[n, i] - before[n, i])
                    inertia += (dt * v[n, i]) ** 2 / inverse_mass[n]
                    before[n, i] = force[n, i]
        residual = math.sqrt(square / scale)
        if residual < tolerance or not residual < math.inf:
            return residual, step
        if step > 0:
            damping = min(2.0 * math.sqrt(max(stiff / inertia, 0.0)) * dt, 1.9)
        for n in range(nodes):
            for i in range(3):
                push = 2.0 * dt * inverse_mass[n] * (force[n, i] + external[n, i])
                v[n, i] = ((2.0 - damping) * v[n, i] + push) / (2.0 + damping)
                u[n, i] += dt * v[n, i]
    return residual, steps


@_fast
@no_type_check
def settle(tables, memory, u, gain, corner, force):
    """Lets the memory forget everything at displacements u: no overstress, no heat, force of the relaxed body."""
    memory.history[:] = 0.0
    internal_force(tables, memory, u, 0.0, gain, corner, force)
    kept = memory.history.copy()
    memory.history[:] = 0.0
    internal_force(tables, memory, u, 0.0, 0.0, corner, force)
    memory.history[:] = kept
    memory.overstress[:] = 0.0
    memory.heat[:] = 0.0


@_fast
@no_type_check
def edge_stretch(points, u, pairs, pitch):
    """Smallest and largest length of the edges `pairs` over the pitch, of nodes at points + u; (-1, -1) where one of
    them is no number."""
    low, high = math.inf, 0.0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        square = 0.0
        for c in range(3):
            way = points[j, c] + u[j, c] - points[i, c] - u[i, c]
            square += way * way
        if not square < math.inf:
            return -1.0, -1.0
        low, high = min(low, square), max(high, square)
    return math.sqrt(low) / pitch, math.sqrt(high) / pitch


def stability_limit(stiffness: Float[np.ndarray, "dofs dofs"], corner_mass: float) -> float:
    """Critical step [s] of a cell with `stiffness` [24, 24] N/m and `corner_mass` [kg]; bounds that of the body."""
    largest = float(np.linalg.eigvalsh(stiffness)[-1])
    return 2.0 / math.sqrt(largest / corner_mass)
