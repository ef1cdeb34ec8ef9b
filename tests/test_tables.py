# SPDX-License-Identifier: MIT
"""Histories as tables of pandas and xarray, and pictures of the points."""

import csv
import sys

import matplotlib
import numpy as np
import pytest
from helpers import beam, column, top_load

import mpm_dolfinx as mpm

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Return the result of a wet column with a tool, and the folder of its files."""
    folder = tmp_path_factory.mktemp("tables")
    held = mpm.Displacement("bottom", (0, 0), name="floor")
    s = column(cells=4, conditions=[top_load(), mpm.Drained("top", name="crest"), held])
    probes = mpm.probes(s.bodies, [[0.05, 0.9], [0.05, 0.2]], stress=True)
    with mpm.Writer(s, folder) as writer:
        return s.run(2.0, 1.0, probes=probes, observe=writer, progress=False), folder


def test_a_data_frame_has_the_columns_of_the_history_and_their_units(ran):
    pandas = pytest.importorskip("pandas")
    result, folder = ran
    frame = result.to_dataframe()
    with open(folder / "history.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    assert isinstance(frame, pandas.DataFrame) and set(frame.columns) <= set(rows[0]) and len(frame) == 3
    for name in frame.columns:
        assert np.array_equal(frame[name], [float(row[name]) for row in rows], equal_nan=True), name
    units = frame.attrs["units"]
    assert units["t"] == "s" and units["uy_1"] == "m" and units["syy_0"] == units["p_min"] == "Pa"
    assert units["reaction_y_floor"] == "N/m, in axisymmetry N" and units["outflow_crest"].startswith("m^2/s")


def test_a_data_set_has_dimensions_and_units(ran):
    pytest.importorskip("xarray")
    data = ran[0].to_xarray()
    assert data["displacement"].dims == ("time", "probe", "axis") and data["displacement"].attrs["units"] == "m"
    assert np.array_equal(data["displacement"], ran[0].displacement) and data["time"].values.tolist() == [0, 1, 2]
    assert data["probe_stress"].sel(row="y", column="y").shape == (3, 2)
    assert data["reaction_floor"].dims == ("time", "axis") and data["outflow_crest"].dims == ("time",)
    assert float(data["p_max"][1]) == ran[0].pressure[1, 1] and data.attrs["steps"] == ran[0].steps


def test_histories_without_anything_asked_for_make_tables():
    pytest.importorskip("pandas"), pytest.importorskip("xarray")
    result = column(cells=4, fluid=False).run(1.0, 1.0, progress=False)
    assert "p_min" not in result.to_dataframe() and result.to_xarray()["displacement"].shape == (2, 0, 2)


@pytest.mark.parametrize("library, make", [("pandas", "to_dataframe"), ("xarray", "to_xarray")])
def test_a_library_that_is_missing_is_named(library, make, ran, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=f"^{library}: .*; must be installed: apt-get install python3-{library}, or"):
        getattr(ran[0], make)()


@pytest.mark.parametrize(
    ("field", "label"),
    [
        ("pressure", "pressure (Pa)"),
        ("displacement", "displacement (m)"),
        ("stress_xx", "stress xx (Pa)"),
        ("J", "J (-)"),
    ],
)
def test_a_plot_has_the_domains_and_the_values_of_the_points(field, label):
    s, _ = beam(h=0.1)
    s.run(0.02, 0.02, progress=False)
    ax = mpm.plot(s, field, cmap="viridis")
    (drawn,) = ax.collections
    assert len(drawn.get_paths()) == len(s.points) and ax.child_axes[0].get_title(loc="right") == label
    wanted = {"pressure": s.points.pressure, "stress_xx": s.point_fields().stress[:, 0, 0], "J": s.points.J}
    wanted["displacement"] = np.linalg.norm(s.points.displacement, axis=1)
    assert np.array_equal(drawn.get_array(), wanted[field])
    low, high = s.points.corners.min(axis=(0, 1)), s.points.corners.max(axis=(0, 1))
    assert ax.get_xlim()[0] <= low[0] and ax.get_ylim()[1] >= high[1] and ax.get_xlabel() == "x (m)"
    ax.figure.canvas.draw()
    assert ax.child_axes[0].get_tightbbox().x1 < ax.figure.bbox.x1, "numbers of the bar are cut off"
    assert mpm.plot(s, field, ax=ax, bar=False) is ax and len(ax.child_axes) == 1
    matplotlib.pyplot.close("all")


def test_a_plot_has_the_stress_of_dry_soil_and_the_saturation_of_unsaturated_soil():
    dry = column(cells=4, fluid=False)
    (drawn,) = mpm.plot(dry, "stress_yy").collections
    assert np.array_equal(drawn.get_array(), dry.point_fields().effective_stress[:, 1, 1])
    grid = mpm.Grid([0, 0], [0.5, 2.5], [1, 5])
    silt = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-6, retention=mpm.Gardner(1e4))
    box = mpm.box(grid, [0, 0], [0.5, 2])
    given = {"fluid": mpm.Fluid(), "pressure": mpm.hydrostatic(1), "gravity": (0, -9.81)}
    wet = mpm.Simulation(grid, [box], [silt], walls={"bottom": "xy"}, **given)
    (drawn,) = mpm.plot(wet, "saturation").collections
    height = wet.points.x[:, 1]
    assert np.abs(drawn.get_array()[height < 1] - 1).max() < 1e-14  # rounding differs between processors
    assert np.all(np.diff(drawn.get_array()[np.argsort(height)][height[np.argsort(height)] > 1][::2]) < 0)
    (drawn,) = mpm.plot(wet, "suction").collections
    assert np.array_equal(drawn.get_array(), np.maximum(-wet.points.pressure, 0))
    with pytest.raises(ValueError, match="plot: field = 'saturation', must be one of") as caught:
        mpm.plot(beam(h=0.1)[0], "saturation")
    assert "softness" not in str(caught.value) and "suction" not in str(caught.value)
    matplotlib.pyplot.close("all")


def test_what_cannot_be_drawn_is_refused():
    dry = column(cells=4, fluid=False)
    with pytest.raises(ValueError, match=r"plot: field = 'pressure', must be one of displacement, .* porosity, "):
        mpm.plot(dry, "pressure")
    grid = mpm.Grid([0, 0, 0], [1, 1, 1], [2, 2, 2])
    cube = mpm.Simulation(grid, [mpm.box(grid, [0, 0, 0], [1, 1, 1])], [mpm.Hencky(1e6, 1e6)], walls={"bottom": "xyz"})
    with pytest.raises(ValueError, match="plot: a scene in 3D, must be in plane strain or axisymmetry"):
        mpm.plot(cube)
