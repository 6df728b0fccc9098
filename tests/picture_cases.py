"""Runs without a solver, for the tests of pictures: a scene, and fields that somebody has thought of."""

import numpy as np
from mpi4py import MPI
from output_cases import centres, slabs

from petfsi.geometry.bodies import build_bodies
from petfsi.output.fields import FieldWriter, field_files
from petfsi.output.frames import Wanted, read_frame
from petfsi.output.pictures import scene_figure
from petfsi.output.stage import look_through
from petfsi.output.xdmf import GridInfo
from petfsi.scene.dump import dump_scene
from petfsi.scene.load import scene_from_dict

#: A body by itself, and the same with a cavity.
BLOCK = {"density": 1.0, "young": 1e3, "poisson": 0.3}


def fluid(dim, size=(2.0, 1.0, 1.0), cells=(16, 8, 8), **more):
    return {"density": 1.0, "origin": [0.0] * dim, "size": list(size[:dim]), "cells": list(cells[:dim]), **more}


def particles(dim, **more):
    fill = [{"box": {"origin": [0.0] * dim, "size": [0.4] * dim}}]
    size = [2.0, 1.0, 1.0][:dim]
    return {"kind": "sph", "density": 1.0, "origin": [0.0] * dim, "size": size, "spacing": 0.1, "fill": fill, **more}


def block(dim, origin=(0.5, 0.3, 0.3), size=(0.4, 0.4, 0.4), cavity=False, **more):
    origin, size = np.array(origin[:dim]), np.array(size[:dim])
    shape = {"box": {"origin": origin.tolist(), "size": size.tolist(), "cells": [4] * dim}}
    if cavity:
        shape["cavity"] = {"origin": (origin + size / 4).tolist(), "size": (size / 2).tolist()}
    return {"shape": shape, **BLOCK, **more}


def spinning(x):
    """Return the velocity of a fluid that turns once in 2 pi s."""
    flow = np.zeros_like(x)
    flow[..., 0], flow[..., 1] = -x[..., 1], x[..., 0]
    return flow


def made_run(directory, times=(0.0,), dim=2, flow=spinning, smoke=False, **tables):
    """Write the scene of a run and its fields; at time t its solids are moved by t (0.1, 0.05, 0)."""
    table = {"dim": dim, "time": {"end": 1.0, "dt": 0.1}, "output": {"every": 0.1}, **tables}
    scene = scene_from_dict(table, directory)
    (directory / "scene.toml").write_text(dump_scene(scene))
    is_grid = scene.fluid is not None and scene.fluid.kind == "mac"
    info = None
    if is_grid:
        spacing = np.array(scene.fluid.size) / scene.fluid.cells
        info = GridInfo(tuple(scene.fluid.origin), tuple(spacing), tuple(scene.fluid.cells))
    writer = FieldWriter(directory, MPI.COMM_SELF, info)
    for step, time in enumerate(times):
        groups = {}
        if is_grid:
            x = centres(info)
            groups["pressure"] = {"velocity": flow(x) * (1 + time), "pressure": x[..., 0] + time}
            groups["pressure"]["kind"] = np.zeros(info.cells, dtype=np.uint8)
            if smoke:
                groups["pressure"]["smoke"] = x[..., 1] + 0.0
        elif scene.fluid is not None:
            x = 0.1 * (np.stack(np.meshgrid(*[np.arange(4)] * dim, indexing="ij"), axis=-1).reshape(-1, dim) + 0.5)
            groups["particles"] = {"points": x, "velocity": flow(x), "pressure": x[:, 1] + time}
        if scene.solids:
            groups["solid"] = _solids(scene, time)
        writer.write(step, time, slabs(groups, MPI.COMM_SELF))
    return scene


def _solids(scene, time):
    points, cells, body = [], [], []
    for number, (x, c) in enumerate(build_bodies(scene).values()):
        cells.append(c + sum(map(len, points)))
        points.append(x)
        body.append(np.full(len(c), number, dtype=np.int32))
    points = np.concatenate(points)
    moved = np.tile(time * np.array([0.1, 0.05, 0.0])[: scene.dim], (len(points), 1))
    static = {"points": points, "cells": np.concatenate(cells).astype(np.int32), "body": np.concatenate(body)}
    return static | {"displacement": moved, "velocity": moved + 1.0}


def figures(directory, quantity=None):
    """Return what is the same in all pictures of a run, and the pictures."""
    paths = field_files(directory)
    stage = look_through(directory, paths, Wanted(quantity=quantity).quantity)
    return stage, [scene_figure(stage, read_frame(path)) for path in paths]
