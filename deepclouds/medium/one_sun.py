"""Walks under one sun, at half the cost of those that serve several: the last direction before the sun is drawn in two ways.

Under a forward peak a walk is bright where it happens to turn toward the sun, seldom and by much. At every vertex, and at the first
point, a side branch leaves in a direction drawn from the lobe around the sun, and is connected where it collides. The walk's own next
collision finds the same light; both are weighted by the densities with which their direction was drawn (Veach and Guibas 1995, balance
heuristic):

    4 pi p(w_i . w) p(w . omega_sun) / (p(w_i . w) + p(w . omega_sun))

for the branch and for the walk alike, which is never above the smaller of both lobes.

Light from all around needs no connection: what a walk sees where it leaves the cloud is such light.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.medium.albedo import AlbedoField
from deepclouds.medium.field import Field
from deepclouds.medium.phase import as_lobes
from deepclouds.medium.walk_parts import (
    TURN,
    Job,
    Queries,
    direction_around,
    inverse_phase,
    remembered,
    sample_phase,
    stream,
    thinned,
    three_uniform,
    two_uniform,
    uniform,
)

# World points and unit vectors (Array3f) and which lanes ask -> Float, infinite where nothing is met.
Ends = Callable[[Any, Any, Any], Any]
# What a lane is tracing: the walk, the shadow of a vertex, a side branch, the shadow of the branch's end.
_WALK, _SHADOW, _BRANCH, _BRANCH_SHADOW = range(4)


class Escapes:
    """Where `count` walks leave the cloud, and where they found the sun, all on the device.

    Attributes
    ----------
    position
        (n,) points in the unit cube of the box: of the last collision.
    direction
        (n,) unit vectors in which they leave it.
    weight
        one Float for each albedo: radiance that comes from there, times the weight and the albedo of the walk's first point, is J; 0 of
        walks that did not collide again, unless they are asked for, and of those that were ended.
    sunlit
        (n,) points in the unit cube of the box: of all vertices that a walk was connected at, one, drawn in proportion to what it found
        there. Whatever else stands between it and the sun multiplies what the whole walk found. Only kept where it is asked for.
    collided
        (n,) 1 of walks that collided again after their first point, 0 of others. Only kept where those are asked for.
    """

    def __init__(self, types: Any, count: int, albedos: int) -> None:
        self.position, self.direction = dr.zeros(types.Array3f, count), dr.zeros(types.Array3f, count)
        self.weight = [dr.zeros(types.Float, count) for _ in range(albedos)]
        self.sunlit = dr.zeros(types.Array3f, count)
        self.collided = dr.zeros(types.Float, count)


def trace_one_sun(
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
    """Unbiased estimates of ``4 pi J / (albedo^2 E)``, one for every walk: `trace_walks` for one sun, with less noise.

    Parameters
    ----------
    field, points, directions, phase, albedos, walks, seed, lanes, roulette
        as for `deepclouds.medium.multiple_scattering.trace_walks`.
    suns
        (n, 3) unit vectors TOWARD the sun.
    connect
        vertices and branches are followed up with probability ``min(1, connect * value)``, weighted by its inverse.

    Returns
    -------
    float32 array (n, walks, m).

    Notes
    -----
    A point outside of the box sends no side branch: there the walk's own collision counts in full.
    """
    n, m_albedos = len(points), albedos.shape[1]
    total = n * walks
    if total == 0 or field.majorant == 0.0:
        return np.zeros((n, walks, m_albedos), np.float32)
    if total * m_albedos >= 2**31:
        raise ValueError(f"{total} walks at once need more than 2^31 results: trace fewer points or walks a call")
    job = Job(field.types, walks, total, m_albedos, seed, lanes, connect, roulette and bool(np.any(albedos < 1)))
    _loop(field, Queries(field.types, points, directions, as_lobes(phase), suns[:, None], albedos), job, _Kind())
    return np.array(job.result).reshape(n, walks, m_albedos)


def begin_to_escape(
    field: Field,
    points: NDArray[np.float32],
    directions: NDArray[np.float32],
    phase: NDArray[np.float32],
    suns: NDArray[np.float32] | None,
    albedos: NDArray[np.float32],
    seed: int,
    lanes: int = 4096,
    varying: AlbedoField | None = None,
    watched: bool = True,
    shaded: bool = False,
    ends: Ends | None = None,
    straight: bool = False,
) -> tuple[Any, Escapes]:
    """Set off walks, one a point, under one sun or none, to where they leave the cloud: there each sees light from all around.

    Parameters
    ----------
    field, points, directions, phase, albedos, seed, lanes
        as for `trace_one_sun`; the walks that have lost most of their weight are thinned out.
    suns
        (n, 3) unit vectors TOWARD the sun, or None for no sun.
    varying
        albedo at the collisions, in place of `albedos`: then the estimates are those of ``4 pi J / (albedo(x) E)``, the albedo at the
        point itself taken out alone, and m is the number of its channels.
    watched
        whether anybody asks for the escapes; those that nobody asks for all have weight 0.
    shaded
        whether anybody asks for `Escapes.sunlit`.
    ends
        distance at which opaque surfaces end rays: inside of the box walks leave the cloud there, and no sun is seen past any of them.
    straight
        whether anybody asks for walks too that leave the cloud straight from their first point: what they see is scattered once.

    Returns
    -------
    Float, n rows of m numbers as of `trace_one_sun`, of zeros without a sun; and the escapes. Whoever reads either waits for the walks.
    """
    if varying is not None:
        albedos = np.ones((len(points), varying.channels), np.float32)
    n, m_albedos = len(points), albedos.shape[1]
    types = field.types
    if n == 0 or field.majorant == 0.0:
        return dr.zeros(types.Float, n * m_albedos), Escapes(types, n, m_albedos)
    if n * m_albedos >= 2**31:
        raise ValueError(f"{n} walks at once need more than 2^31 results: trace fewer points a call")
    toward = np.broadcast_to(np.array([0, 0, 1], np.float32), (n, 3)) if suns is None else suns
    job = Job(types, 1, n, m_albedos, seed, lanes, 1.0, bool(varying is not None or np.any(albedos < 1)))
    escapes = Escapes(types, n, m_albedos)
    dr.make_opaque(escapes.position, escapes.direction, escapes.weight, escapes.sunlit, escapes.collided)
    kind = _Kind(
        varying, suns is not None, escapes if watched else None, escapes.sunlit if shaded and suns is not None else None, ends, straight
    )
    _loop(field, Queries(types, points, directions, as_lobes(phase), toward[:, None], albedos), job, kind)
    dr.eval(job.result, escapes.position, escapes.direction, escapes.weight, escapes.sunlit, escapes.collided)
    return job.result, escapes


def trace_to_escape(field: Field, points: NDArray[np.float32], *more: Any, **how: Any) -> tuple[NDArray[np.float32], Escapes]:
    """`begin_to_escape`, done: float32 array (n, m) and the escapes."""
    result, escapes = begin_to_escape(field, points, *more, **how)
    return np.array(result).reshape(len(points), len(escapes.weight)), escapes


class _Kind:
    """What a kernel of walks does: see the functions above. Not a dataclass, of which Dr.Jit would make variables of the loop."""

    def __init__(
        self,
        varying: AlbedoField | None = None,
        sunlit: bool = True,
        escapes: Escapes | None = None,
        drawn: Any = None,
        ends: Ends | None = None,
        straight: bool = False,
    ) -> None:
        self.varying, self.sunlit, self.escapes, self.drawn, self.ends = varying, sunlit, escapes, drawn, ends
        self.straight = straight


@dr.syntax
def _loop(field: Field, queries: Queries, job: Job, kind: _Kind) -> None:
    types = field.types
    result, counter, key, lanes = job.result, job.counter, job.key, job.lanes
    varying, escapes, drawn, ends = kind.varying, kind.escapes, kind.drawn, kind.ends
    Float, UInt32, Bool, Array3f = types.Float, types.UInt32, types.Bool, types.Array3f
    m_albedos = len(queries.albedos)
    walks_each = dr.opaque(UInt32, job.walks)
    limit = dr.opaque(UInt32, job.total)
    often, least = dr.opaque(Float, job.connect), dr.opaque(Float, 1.0 / job.connect)

    alive = dr.full(Bool, True, lanes)
    ended = dr.full(Bool, True, lanes)
    begun = dr.full(Bool, False, lanes)  # at its first point, inside of the box, with nothing sent out yet
    number = dr.full(UInt32, 0xFFFFFFFF, lanes)
    rng = [dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)]
    task = dr.zeros(UInt32, lanes)
    position = dr.zeros(Array3f, lanes)  # of the last vertex, in the unit cube of the box
    landing = dr.zeros(Array3f, lanes)  # of the side branch, likewise
    direction = dr.zeros(Array3f, lanes)  # of the walk, world
    side = dr.zeros(Array3f, lanes)  # of the side branch, world
    rivalry = dr.zeros(Float, lanes)  # 1 over the density with which `direction` was drawn, sr; 0 where no side branch competes
    distance = dr.zeros(Float, lanes)  # along the current segment, world units
    value = dr.zeros(Float, lanes)  # of the connection or branch that is followed up
    lobes = [remembered(a, lanes) for a in queries.lobes]
    sun = Array3f(*(remembered(a, lanes) for a in queries.suns[0]))
    albedo = [remembered(a, lanes) for a in queries.albedos]
    weight = [dr.zeros(Float, lanes) for _ in range(m_albedos)]
    found = [dr.zeros(Float, lanes) for _ in range(m_albedos)]  # of the walk so far
    # Albedo where a branch has landed, if it varies; else the weight has it already.
    of_branch_end = [dr.full(Float, 1, lanes) for _ in range(m_albedos if varying is not None else 0)]
    # One of the connected vertices, where it is asked for: its place, and its share of what it found by albedo.
    vertex = [dr.zeros(Float, lanes) for _ in range(3 if drawn is not None else 0)]
    parts = [dr.zeros(Float, lanes) for _ in range(m_albedos if drawn is not None else 0)]

    reach = dr.full(Float, np.inf, lanes)  # at which a surface ends the current segment

    scattered = dr.full(Bool, False, lanes)  # has collided since its first point
    left = dr.full(Bool, False, lanes)  # has left the cloud after that

    clock = dr.zeros(UInt32, lanes)

    while alive:
        # As in `trace_walks`: lanes that have ended wait for a common turn.
        if ended & (clock % TURN == 0):
            if drawn is not None:
                # Reservoir sampling (Chao 1982): with the probability of its part the vertex stands for all of them.
                total = sum(found[1:], found[0])
                for m in range(m_albedos):
                    found[m] = total * parts[m]
                for i in range(3):
                    dr.scatter(drawn[i], vertex[i], number, number < limit)
            for m in range(m_albedos):
                dr.scatter(result, found[m], number * m_albedos + m, number < limit)
                found[m] = Float(0)
            if escapes is not None:
                for c in range(3):
                    dr.scatter(escapes.position[c], position[c], number, left)
                    dr.scatter(escapes.direction[c], direction[c], number, left)
                for m in range(m_albedos):
                    dr.scatter(escapes.weight[m], weight[m], number, left)
                if kind.straight:
                    dr.scatter(escapes.collided, dr.select(scattered, Float(1), 0), number, left)
            scattered, left = Bool(False), Bool(False)
            number = dr.scatter_inc(counter, UInt32(0), Bool(True))
            alive = number < limit
            point = number // walks_each
            rng = stream(types, key, number)
            for i in range(len(lobes)):
                if dr.width(queries.lobes[i]) > 1:
                    lobes[i] = dr.gather(Float, queries.lobes[i], point, alive)
            incoming = Array3f(*(dr.gather(Float, a, point, alive) for a in queries.directions))
            origin = Array3f(*(dr.gather(Float, a, point, alive) for a in queries.points))
            for c in range(3):
                if dr.width(queries.suns[0][c]) > 1:
                    sun[c] = dr.gather(Float, queries.suns[0][c], point, alive)
            for m in range(m_albedos):
                if dr.width(queries.albedos[m]) > 1:
                    albedo[m] = dr.gather(Float, queries.albedos[m], point, alive)
                weight[m] = Float(1)
            unit = field.to_unit(origin)
            begun = alive & field.holds_unit(unit)
            rng, u_cosine, u_azimuth = two_uniform(types, rng)
            beside, _ = sample_phase(lobes, u_cosine)
            ahead = direction_around(incoming, beside, u_azimuth)
            enter, leave = field.intersect(origin, ahead)
            # From outside the walk begins where it enters; a ray that misses the box starts far beyond it, and so escapes at once.
            position = dr.select(begun, unit, dr.clip(field.to_unit(dr.fma(ahead, enter, origin)), 0, 1))
            distance = dr.select(begun | (leave > enter), 0, 1e32)
            direction = dr.select(begun, incoming, ahead)
            rivalry = Float(0)
            task = UInt32(_WALK)
            ended = Bool(False)

        clock += 1
        traced = alive & ~ended & ~begun
        walking = task == _WALK
        heading = dr.select(walking, direction, dr.select(task == _BRANCH, side, sun))
        start = dr.select(task == _BRANCH_SHADOW, landing, position)

        rng, u_step = uniform(types, rng)
        rng, u_event = uniform(types, rng)
        along = field.direction_to_unit(heading)
        if ends is not None:
            fresh = traced & (distance == 0)
            if fresh:
                reach = ends(field.to_world(start), heading, fresh)
        distance, tentative, mean_path = field.majorants.step(start, along, distance, u_step, traced)
        unit = dr.fma(along, distance, start)
        inside = traced & field.holds_unit(unit)
        if ends is not None:
            inside &= distance < reach
        rng, thirds = three_uniform(types, rng)
        sigma = field.drawn_unit(unit, thirds, inside & tentative)
        # Where a turn and a side branch would lead, of which a lane takes one at most.
        rng, u_cosine, u_azimuth = two_uniform(types, rng)
        beside, of_walk = sample_phase(lobes, u_cosine)
        onward = direction_around(direction, beside, u_azimuth)
        of_vertex, of_branch, u_branch, around = Float(0), Float(0), Float(0), sun
        if kind.sunlit:
            of_vertex = 4 * np.pi * dr.rcp(inverse_phase(lobes, dr.dot(direction, sun)) + rivalry)
            rng, u_cosine, u_azimuth = two_uniform(types, rng)
            rng, u_branch = uniform(types, rng)
            beside, of_sun = sample_phase(lobes, u_cosine)
            around = direction_around(sun, beside, u_azimuth)
            of_branch = 4 * np.pi * dr.rcp(inverse_phase(lobes, dr.dot(direction, around)) + of_sun)
        hit = inside & tentative & (u_event < sigma * mean_path)
        gone = traced & ~inside
        over = hit | gone

        collision, landed = hit & walking, hit & (task == _BRANCH)
        scattered |= collision
        if varying is not None:
            # The weight of a vertex has its own albedo already when it is connected.
            here = varying.at_unit(unit, hit)
            for m in range(m_albedos):
                weight[m] = dr.select(collision, weight[m] * here[m], weight[m])
                of_branch_end[m] = dr.select(landed, here[m], of_branch_end[m])
        position = dr.select(collision, unit, position)
        leaving = begun | collision
        branch, shadow = Bool(False), Bool(False)
        if kind.sunlit:
            lit = gone & ((task == _SHADOW) | (task == _BRANCH_SHADOW))
            if ends is not None:
                # Surfaces beyond the box shade as well.
                lit &= ~(reach < np.inf)
            arriving = [value * weight[m] for m in range(m_albedos)]
            for m in range(m_albedos):
                if varying is not None:
                    arriving[m] *= dr.select(task == _BRANCH_SHADOW, of_branch_end[m], 1)
                found[m] += dr.select(lit, arriving[m], 0)
            if drawn is not None:
                here, all_so_far = sum(arriving[1:], arriving[0]), sum(found[1:], found[0])
                rng, u_drawn = uniform(types, rng)
                chosen = lit & (u_drawn * all_so_far < here)
                place = dr.select(task == _BRANCH_SHADOW, landing, position)
                for i in range(3):
                    vertex[i] = dr.select(chosen, place[i], vertex[i])
                for m in range(m_albedos):
                    parts[m] = dr.select(chosen, arriving[m] / dr.maximum(here, 1e-30), parts[m])
            # Given a collision, u_event is uniform below sigma * mean_path: stretched, it decides the roulette of the connection.
            shadow = collision & (u_event < sigma * mean_path * (often * of_vertex))
            leaving = begun | (collision & ~shadow) | (over & (task == _SHADOW))
        if varying is None:
            for m in range(m_albedos):
                weight[m] = dr.select(leaving & ~begun, weight[m] * albedo[m], weight[m])
        if kind.sunlit:
            # Once a vertex is dealt with, light of the next order may come by a side branch.
            branch = leaving & (u_branch < often * of_branch)
            side = dr.select(branch, around, side)
            landing = dr.select(landed, unit, landing)
            value = dr.select(shadow, dr.maximum(of_vertex, least), dr.select(branch, dr.maximum(of_branch, least), value))

        turn = (leaving & ~branch) | (gone & (task == _BRANCH)) | (over & (task == _BRANCH_SHADOW))
        direction = dr.select(turn, onward, direction)
        rivalry = dr.select(turn, of_walk, rivalry)
        left |= gone & walking if kind.straight else gone & walking & scattered
        ended |= gone & walking
        if job.roulette:
            rng, lost, weight = thinned(types, rng, weight, turn & ~begun)
            ended |= lost
        distance = dr.select(over | begun, 0, distance)
        task = dr.select(shadow, UInt32(_SHADOW), dr.select(branch, UInt32(_BRANCH), dr.select(landed, UInt32(_BRANCH_SHADOW), task)))
        task = dr.select(turn, UInt32(_WALK), task)
        begun = Bool(False)
