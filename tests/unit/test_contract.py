"""The contract: rows of aux, metadata, and the hash of the weights."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deepclouds import descriptor
from deepclouds.errors import InputError
from deepclouds.model import AUX, LEVELS, POINTS, DescriptorSpec, ModelMetadata, aux_inputs, initialiser_hash, multiple_scattering

RANGES = {**{a.name: (0.0, 1.0) for a in AUX}, "tau": (0.0, float(np.expm1(1.0)))}


def metadata() -> ModelMetadata:
    return ModelMetadata(
        name="a = b",
        created_by="deepclouds 0.1",
        ranges=RANGES,
        config_hash="c" * 64,
        dataset_hash="d" * 64,
        metrics={"all.rrmse": 0.1 + 0.2},
        initialisers_sha256="e" * 64,
    )


def test_aux_row_has_the_documented_order_and_units() -> None:
    row = aux_inputs(0.5, 0.85, -0.25, 0.75, 0.99, np.e - 1)
    assert row.dtype == np.float32
    np.testing.assert_allclose(row, [[0.5, 0.85, -0.25, 0.75, 0.99, 1.0]], rtol=1e-6)
    assert [a.name for a in AUX] == ["gamma", "g1", "g2", "lobe_weight", "albedo", "log1p_tau"]


def test_aux_broadcasts_scalars_against_arrays() -> None:
    rows = aux_inputs(np.linspace(0, np.pi, 5), 0.85, 0.0, 1.0, 1.0, np.zeros(5))
    assert rows.shape == (5, 6)
    assert np.all(rows[:, 1] == np.float32(0.85))
    assert rows[-1, 0] == np.float32(np.pi)


@pytest.mark.parametrize(
    ("column", "value"),
    [(0, -0.1), (0, 3.2), (1, 1.1), (2, -1.1), (3, 1.5), (4, -0.01), (4, 1.01), (5, -1.0), (5, np.inf), (0, np.nan), (5, np.nan)],
)
def test_aux_refuses_what_makes_no_sense(column: int, value: float) -> None:
    arguments = [1.0, 0.85, 0.0, 1.0, 0.9, 3.0]
    arguments[column] = value
    with pytest.raises(ValueError, match="tau" if column == 5 else AUX[column].name):
        aux_inputs(*arguments)


def test_source_term_vanishes_without_albedo_and_follows_the_definition() -> None:
    assert multiple_scattering(3.0, 0.0, 5.0) == 0.0
    np.testing.assert_allclose(multiple_scattering([1.0, 2.0], 0.5, 4 * np.pi), [0.25, 0.5])


def test_stencil_of_the_contract_is_the_descriptors() -> None:
    spec = DescriptorSpec()
    places = descriptor.offsets() * descriptor.FIRST_SPACING
    assert (spec.levels, spec.points) == (LEVELS, POINTS) == (descriptor.LEVELS, descriptor.POINTS)
    assert spec.lower == tuple(places.min(axis=0))
    assert spec.upper == tuple(places.max(axis=0))
    assert spec.grid == tuple(len(np.unique(places[:, axis])) for axis in (2, 1, 0))
    # x runs fastest, then y, then z.
    assert np.flatnonzero(np.diff(places[:, 0]))[0] == 0
    assert np.flatnonzero(np.diff(places[:, 1]))[0] == 4
    assert np.flatnonzero(np.diff(places[:, 2]))[0] == 24


def test_metadata_survives_the_trip_through_strings() -> None:
    properties = metadata().to_properties()
    assert all(isinstance(k, str) and isinstance(v, str) for k, v in properties.items())
    assert ModelMetadata.from_properties({**properties, "another program": "ignored"}, "m.onnx") == metadata()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"deepclouds.contract": "0"}, "contract version '0'"),
        ({"deepclouds.contract": None}, "no deepclouds metadata"),
        ({"deepclouds.ranges": "not json"}, "malformed"),
        ({"deepclouds.ranges": '{"gamma": [0, 1]}'}, "ranges"),
        ({"deepclouds.unheard_of": '"1"'}, "unheard_of"),
        ({"deepclouds.dataset_hash": None}, "dataset_hash"),
    ],
)
def test_bad_metadata_is_refused_by_name(change: dict[str, str | None], message: str) -> None:
    properties = {**metadata().to_properties(), **change}
    with pytest.raises(InputError, match=message) as caught:
        ModelMetadata.from_properties({k: v for k, v in properties.items() if v is not None}, "m.onnx")
    assert "m.onnx" in str(caught.value)


@pytest.mark.parametrize("change", [{"aux": ("g1",)}, {"output": "J"}, {"descriptor": DescriptorSpec(levels=9)}])
def test_metadata_of_another_layout_is_refused(change: dict[str, object]) -> None:
    metadata().require_this_contract("m.onnx")
    with pytest.raises(InputError, match=next(iter(change))):
        metadata().model_copy(update=change).require_this_contract("m.onnx")


def test_ranges_must_be_finite_and_ordered() -> None:
    for bad in ((1.0, 0.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="gamma"):
            ModelMetadata(**{**metadata().model_dump(), "ranges": {**RANGES, "gamma": bad}})


def test_hash_depends_on_everything_but_the_order() -> None:
    a, b = np.arange(6, dtype=np.float32).reshape(2, 3), np.ones(4, np.float32)
    first = initialiser_hash([("a", a), ("b", b)])
    assert first == initialiser_hash([("b", b), ("a", np.asfortranarray(a))])
    assert first == initialiser_hash([("a", a.astype(">f4")), ("b", b)])
    changed = a.copy()
    changed[1, 2] = np.nextafter(changed[1, 2], np.float32(9))
    for other in (("a", changed), ("A", a), ("a", a.ravel()), ("a", a.astype(np.float64))):
        assert initialiser_hash([other, ("b", b)]) != first
    assert initialiser_hash([("a", a)]) != first


def test_aux_inputs_are_described() -> None:
    for entry in AUX:
        assert all(getattr(entry, field.name) not in ("", None) for field in dataclasses.fields(entry))
