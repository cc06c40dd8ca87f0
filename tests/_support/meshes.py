"""A fixture of the tests of meshes."""

import warnings

import pytest

import curvireg_torch as cr


@pytest.fixture
def load():
    """A function that loads a mesh, and returns it with the texts of its warnings, but for that of
    its size."""

    def read(path, **options):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            mesh = cr.load_mesh(path, **options)
        texts = [str(one.message) for one in caught if " m across" not in str(one.message)]
        return mesh, texts

    return read
