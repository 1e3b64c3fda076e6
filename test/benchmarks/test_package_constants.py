"""Numbers of the package that a benchmark varies: they get other values, and their own ones back."""

from common.package_constants import constants, varied

from sq_perception.segmentation.options import SegmentationOptions


def test_defaults_of_options_get_other_values_and_their_own_ones_back() -> None:
    before = SegmentationOptions()
    defaults = [constant for constant in constants("segmentation") if constant.field]
    assert {constant.field for constant in defaults} == {"max_objects", "max_size"}
    for constant in defaults:
        value = constant.value
        constant.set(varied(value, 0.7))
        assert getattr(SegmentationOptions(), constant.field) < value
        constant.set(value)
    assert SegmentationOptions() == before
