"""The corpus of exact solids: what is known of its shapes is so, and a run of it is judged."""

from __future__ import annotations

import json
from pathlib import Path

import corpus
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vorolight.stages.mesh.polygons import PolygonMesh
from vorolight.stages.mesh.topology import topology


@settings(max_examples=20, deadline=None)
@given(index=st.integers(0, 400), n=st.sampled_from([15, 25]))
def test_shapes_are_closed_of_one_size_and_the_same_every_time(index: int, n: int) -> None:
    one, other = corpus.shape(index, n), corpus.shape(index, n)
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.triangles, other.triangles)
    assert np.ptp(one.vertices, axis=0).max() == pytest.approx(corpus.SIZE)
    facts = topology(PolygonMesh.of_triangles(one.vertices, one.triangles))
    assert facts.closed
    assert facts.euler_number + facts.pinched_vertices == one.euler_number


def test_what_is_known_of_some_shapes() -> None:
    plate, nested, holes = (corpus.shape(index, 25) for index in (9, 39, 5))
    assert (plate.euler_number, plate.components) == (2, 1)
    assert (nested.euler_number, nested.components) == (4, 2)
    assert (holes.euler_number, holes.components) == (-4, 1)  # three holes


def test_a_run_is_certified_and_judged_by_the_file(tmp_path: Path) -> None:
    known = corpus.shape(27, 6)
    row = corpus.run(known, 6, tmp_path, [])
    assert corpus.right(row), row
    assert row["cd2"] < 1e-5
    assert json.loads((tmp_path / f"{known.name}.row").read_text()) == row
    assert not corpus.right(row | {"topology": [0, 2]})
    assert "for [4, 2]" in corpus.line(row | {"topology": [0, 2]})
    refused = corpus.run(corpus.shape(9, 15), 15, tmp_path, ["--sphere-train-max-faces", "200"])
    assert not corpus.right(refused)
