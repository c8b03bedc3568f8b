"""Tests that take `format` run once for each format."""

from __future__ import annotations

import pytest
from artefacts import FORMATS, HAS_COMPILER

from csac.deploy.artefact import Format


@pytest.fixture(params=FORMATS)
def format(request) -> Format:
    if request.param == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    if request.param == "c" and not HAS_COMPILER:
        pytest.skip("no C compiler here")
    return request.param
