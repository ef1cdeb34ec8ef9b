# SPDX-License-Identifier: MIT
"""An incomplete or altered checkpoint is refused in one line, and does not change the scene."""

import json

import numpy as np
import pytest
from helpers import column

import mpm_dolfinx as mpm


def scene(wet, load):
    options = {"conditions": [mpm.Drained("top")]} if wet else {}
    return column(
        cells=4,
        fluid=wet,
        conditions=[mpm.Traction("top", lambda t: (0, -load * t)), *options.pop("conditions", [])],
        **options,
    )


def noted(change):
    """Return a function that alters the metadata of a checkpoint."""

    def alter(arrays):
        note = json.loads(str(arrays["note"]))
        arrays["note"] = np.array(json.dumps(change(note)))

    return alter


def rows(name, change):
    """Return a function that alters an array of a checkpoint."""

    def alter(arrays):
        arrays[name] = change(arrays[name])

    return alter


ALTERED = {
    "an array is missing": lambda arrays: arrays.pop("points/F"),
    "histories are missing": lambda arrays: arrays.pop("result/t"),
    "one array too many": lambda arrays: arrays.update(more=np.zeros(3)),
    "too short": rows("points/x", lambda x: x[:-1]),
    "too wide": rows("points/x", lambda x: np.pad(x, ((0, 0), (0, 1)))),
    "integers": rows("points/corners", lambda x: x.astype(np.int32)),
    "words": rows("points/F", lambda F: F.astype(str)),
    "nan": rows("points/volume0", lambda v: np.where(np.arange(len(v)) == 2, np.nan, v)),
    "points twice": rows("points/id", lambda i: np.where(i == 1, 0, i)),
    "no JSON": lambda arrays: arrays.update(note=np.array("{")),
    "a list": noted(lambda note: [note]),
    "without time": noted(lambda note: {k: v for k, v in note.items() if k != "t"}),
    "a word as time": noted(lambda note: note | {"t": "soon"}),
    "no time at all": noted(lambda note: note | {"t": float("nan")}),
    "histories of another kind": noted(lambda note: note | {"result": {"stepps": 3}}),
    "no scene": noted(lambda note: note | {"scene": None}),
}
PIECES = {
    "pressures missing": lambda arrays: arrays.pop(
        next(n for n in arrays if n in ("pieces/pressure", "pieces/of_cell"))
    ),
    "pressures of other points": lambda arrays: arrays.update(
        {n: np.zeros_like(a) for n, a in arrays.items() if n == "pieces/id"}
    ),
}


@pytest.mark.parametrize("load", [1e2, 1e6], ids=["staying", "moving"])
@pytest.mark.parametrize("wet", [False, True], ids=["dry", "wet"])
def test_what_has_been_altered_is_refused(wet, load, tmp_path):
    file = tmp_path / "run.ckpt"
    s = scene(wet, load)
    s.run(2.0, 1.0, progress=False, checkpoint=mpm.Checkpoint(file))
    assert (s.state.stay is not None) == (load < 1e3)
    whole = dict(np.load(file))
    for name, alter in {**ALTERED, **(PIECES if wet else {})}.items():
        arrays = dict(whole)
        alter(arrays)
        with open(file, "wb") as f:
            np.savez(f, **arrays)
        other = scene(wet, load)
        before = other.state
        with pytest.raises(ValueError) as caught:
            mpm.resume(other, file)
        assert str(file) in str(caught.value) and "\n" not in str(caught.value), name
        assert other.state is before, name


def law(k):
    return lambda conductivity, J: conductivity * J**k


OTHERS = {
    "field": (lambda X: 1e7 + X[:, 1], lambda X: 1e8 + X[:, 1], None, None),
    "conductivity law": (1e7, 1e7, law(2), law(3)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_scene_with_other_fields_or_laws_is_refused(name, tmp_path):
    bulk, other_bulk, k, other_k = OTHERS[name]
    file = tmp_path / "run.ckpt"
    sand, other = (
        mpm.Hencky(bulk=b, shear=5e6, conductivity=1e-4, conductivity_law=l)
        for b, l in ((bulk, k), (other_bulk, other_k))
    )
    column(cells=4, material=sand).run(2.0, 1.0, progress=False, checkpoint=mpm.Checkpoint(file))
    assert mpm.resume(column(cells=4, material=sand), file).t.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match=f"checkpoint of another scene: .*{name.split()[0]}|checksum of bulk"):
        mpm.resume(column(cells=4, material=other), file)


def test_a_map_is_part_of_the_scene(tmp_path):
    grid, made = mpm.Grid([0, 0], [2.0, 2.0], [4, 4]), []
    for bend in (0.1, 0.2):
        body = mpm.mapped(
            grid, mpm.box(grid, [0, 0], [1, 1]), lambda x, bend=bend: x * [1, 1] + bend * x[:, ::-1] * [1, 0]
        )
        made.append(mpm.Simulation(grid, [body], [mpm.Hencky(1e7, 5e6)], walls={"bottom": "xy"}))
    made[0].run(1.0, 1.0, progress=False, checkpoint=mpm.Checkpoint(tmp_path / "x"))
    with pytest.raises(ValueError, match="checksum of the positions of body 0"):
        mpm.resume(made[1], tmp_path / "x")
