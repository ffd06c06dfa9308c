"""Monte Carlo labels: multiple scattering J at given points, by delta tracking with next-event estimation.

One walk serves several suns and several albedos: the walk does not depend on either (brief: the label's definition in
docs/conventions.md). The estimator is

    j = 4 pi J / (albedo^2 E) = sum over collisions i >= 1 of albedo^(i - 1) 4 pi p(w_i . omega_sun) T(x_i -> omega_sun)

over a walk that leaves the point x in a direction drawn from the phase function around w; x itself is never connected to the sun.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.medium.field import Field
from deepclouds.medium.phase import as_lobes
from deepclouds.medium.walk_parts import (
    TURN,
    Job,
    Queries,
    direction_around,
    phase_value,
    remembered,
    sample_phase,
    stream,
    thinned,
    three_uniform,
    two_uniform,
    uniform,
)


def trace_walks(
    field: Field,
    points: NDArray[np.float32],
    directions: NDArray[np.float32],
    phase: NDArray[np.float32],
    suns: NDArray[np.float32],
    albedos: NDArray[np.float32],
    walks: int,
    seed: int,
    lanes: int = 4096,
    connect: float = 1.0,
    roulette: bool = False,
) -> NDArray[np.float32]:
    """Unbiased estimates of ``4 pi J / (albedo^2 E)``, one for every walk.

    Parameters
    ----------
    field
        the extinction.
    points
        (n, 3) world points, inside or outside of the box.
    directions
        (n, 3) unit vectors w, the camera ray's travel.
    phase
        (n, 3) lobes (g1, g2, weight) of `deepclouds.medium.phase.two_lobe`, or (n,) parameters g of single lobes.
    suns
        (n, k, 3) unit vectors TOWARD the suns that every walk of a point is connected to.
    albedos
        (n, m) single-scattering albedos evaluated for every walk.
    walks
        walks per point.
    seed
        root of the random streams; a walk's stream depends on `seed` and its own number alone, so the result does not depend on
        `lanes` or on the scheduling.
    lanes
        walks in flight; each lane takes the next walk as soon as its own has ended, and every walk that started is finished.
    connect
        a collision is connected to a sun with probability ``min(1, connect * 4 pi p)``, weighted by its inverse: the connections
        that carry little are thinned out, without bias.
    roulette
        end most of the walks that have lost nine tenths of their weight under every albedo, and let the others stand for them. A walk then
        depends on the albedos.

    Returns
    -------
    float32 array (n, walks, k, m).

    Notes
    -----
    Majorants are local (`deepclouds.medium.majorants`). Shadow rays are delta tracked (0 or 1). The roulette of a connection sees
    the walk's past only.
    Source: Woodcock et al. 1965; Novak et al. 2018 (CGF 37(2), sections 5 and 6).
    """
    n, k_suns, m_albedos = len(points), suns.shape[1], albedos.shape[1]
    total = n * walks
    if total == 0 or field.majorant == 0.0:
        return np.zeros((n, walks, k_suns, m_albedos), np.float32)
    if total * k_suns * m_albedos >= 2**31:
        raise ValueError(f"{total} walks at once need more than 2^31 results: trace fewer points or walks a call")
    types = field.types
    queries = Queries(types, points, directions, as_lobes(phase), suns, albedos)
    job = Job(types, walks, total, k_suns * m_albedos, seed, lanes, connect, roulette and bool(np.any(albedos < 1)))
    _loop(field, queries, job)
    return np.array(job.result).reshape(n, walks, k_suns, m_albedos)


@dr.syntax
def _loop(field: Field, queries: Queries, job: Job) -> None:
    types = field.types
    result, counter, key, lanes = job.result, job.counter, job.key, job.lanes
    Float, UInt32, Bool, Array3f = types.Float, types.UInt32, types.Bool, types.Array3f
    k_suns, m_albedos = len(queries.suns), len(queries.albedos)
    walks_each = dr.opaque(UInt32, job.walks)
    limit = dr.opaque(UInt32, job.total)
    connect_4pi = dr.opaque(Float, 4.0 * np.pi * job.connect)
    least = dr.opaque(Float, 1.0 / job.connect)

    alive = dr.full(Bool, True, lanes)
    ended = dr.full(Bool, True, lanes)
    number = dr.full(UInt32, 0xFFFFFFFF, lanes)
    rng = [dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)]
    position = dr.zeros(Array3f, lanes)  # of the last collision, in the unit cube of the box
    direction = dr.zeros(Array3f, lanes)  # of the walk, world
    distance = dr.zeros(Float, lanes)  # along the current segment, world units
    lobes = [remembered(a, lanes) for a in queries.lobes]
    pending = dr.zeros(UInt32, lanes)  # bit k: the connection to sun k is still to be traced
    suns = [Array3f(*(remembered(a, lanes) for a in sun)) for sun in queries.suns]
    albedo = [remembered(a, lanes) for a in queries.albedos]
    weight = [dr.zeros(Float, lanes) for _ in range(m_albedos)]

    clock = dr.zeros(UInt32, lanes)

    while alive:
        # To take the next walk costs as much as several steps, and lanes run in step with each other: those that have ended wait for a
        # common turn. A lane retires when no walk is left.
        if ended & (clock % TURN == 0):
            number = dr.scatter_inc(counter, UInt32(0), Bool(True))
            alive = number < limit
            point = number // walks_each
            rng = stream(types, key, number)
            for i in range(len(lobes)):
                if dr.width(queries.lobes[i]) > 1:
                    lobes[i] = dr.gather(Float, queries.lobes[i], point, alive)
            rng, u_cosine, u_azimuth = two_uniform(types, rng)
            incoming = Array3f(*(dr.gather(Float, a, point, alive) for a in queries.directions))
            beside, _ = sample_phase(lobes, u_cosine)
            direction = direction_around(incoming, beside, u_azimuth)
            origin = Array3f(*(dr.gather(Float, a, point, alive) for a in queries.points))
            enter, leave = field.intersect(origin, direction)
            # A ray that misses the box starts far beyond it, and so escapes at its first step.
            position = dr.clip(field.to_unit(dr.fma(direction, enter, origin)), 0, 1)
            distance = dr.select(leave > enter, 0, 1e32)
            for k in range(k_suns):
                for c in range(3):
                    if dr.width(queries.suns[k][c]) > 1:
                        suns[k][c] = dr.gather(Float, queries.suns[k][c], point, alive)
            for m in range(m_albedos):
                if dr.width(queries.albedos[m]) > 1:
                    albedo[m] = dr.gather(Float, queries.albedos[m], point, alive)
                weight[m] = Float(1)
            pending = UInt32(0)
            ended = Bool(False)

        clock += 1
        traced = alive & ~ended
        shadow = pending != 0
        lowest = pending & (~pending + 1)
        sun = suns[0]
        for k in range(1, k_suns):
            sun = dr.select(lowest == (1 << k), suns[k], sun)
        heading = dr.select(shadow, sun, direction)

        rng, u_step = uniform(types, rng)
        rng, u_event = uniform(types, rng)
        along = field.direction_to_unit(heading)
        distance, tentative, mean_path = field.majorants.step(position, along, distance, u_step, traced)
        unit = dr.fma(along, distance, position)
        inside = traced & field.holds_unit(unit)
        rng, thirds = three_uniform(types, rng)
        sigma = field.drawn_unit(unit, thirds, inside & tentative)
        hit = inside & tentative & (u_event < sigma * mean_path)

        collision = hit & ~shadow
        connected = traced & shadow & ~inside
        value = dr.select(connected, dr.maximum(4 * np.pi * phase_value(lobes, dr.dot(direction, sun)), least), 0)
        # A walk's results are its lane's alone.
        first = (number * k_suns + dr.popcnt(lowest - 1)) * m_albedos
        for m in range(m_albedos):
            dr.scatter_add(result, value * weight[m], first + m, connected, mode=dr.ReduceMode.NoConflicts)
        pending = dr.select(connected | (shadow & hit), pending & ~lowest, pending)

        # Given a collision, u_event is uniform below sigma * mean_path: stretched, it decides the roulette of the connections.
        u_connect = u_event / (sigma * mean_path)
        chosen = UInt32(0)
        for k in range(k_suns):
            u_k = u_connect + 0.6180339887 * k
            u_k = u_k - dr.floor(u_k)
            chosen |= dr.select(u_k < connect_4pi * phase_value(lobes, dr.dot(direction, suns[k])), UInt32(1 << k), UInt32(0))
        pending = dr.select(collision, chosen, pending)
        position = dr.select(collision, unit, position)
        distance = dr.select(collision | connected | (shadow & hit), 0, distance)

        turn = (pending == 0) & (collision | (shadow & (connected | hit)))
        rng, u_cosine, u_azimuth = two_uniform(types, rng)
        beside, _ = sample_phase(lobes, u_cosine)
        direction = dr.select(turn, direction_around(direction, beside, u_azimuth), direction)
        for m in range(m_albedos):
            weight[m] = dr.select(turn, weight[m] * albedo[m], weight[m])
        ended |= traced & ~inside & ~shadow
        if job.roulette:
            rng, lost, weight = thinned(types, rng, weight, turn)
            ended |= lost
