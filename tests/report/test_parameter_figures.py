"""Drawings of the fitted parameters: nothing of them is cut."""

import io

import numpy as np
import pytest

from droid_jax.report.parameter_figures import correlation_map


@pytest.mark.parametrize("width", [7.0, 4.0])
@pytest.mark.parametrize("format", ["svg", "pdf", "png"])
def test_the_labels_of_a_correlation_map_lie_inside_of_it(width: float, format: str):
    names = ("torsional_friction_right", "hinge_friction", "a_long_name_that_someone_gave")
    figure = correlation_map(names, np.eye(3), width)
    figure.savefig(io.BytesIO(), format=format)
    box, (right, top) = figure.get_tightbbox().extents, figure.get_size_inches()
    assert min(box[:2]) > 0 and box[2] < right and box[3] < top
