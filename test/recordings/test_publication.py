"""What the cloud says of a body beside its parameters: how sure each of them is, and why a body is weak."""

from dataclasses import replace

import numpy as np
import pytest
from std_msgs.msg import Header

from sq_msgs_py import poses, superquadrics
from sq_msgs_py.superquadrics import FAILED, WEAK, Reason
from sq_perception import Fit, FrameRecovery, Parts, Recovery, Status, Superquadric
from sq_perception.recordings import publication
from sq_perception.recovery.cavities import Cavity
from sq_perception.tracking.session import Followed

BODY = Superquadric([0.05, 0.04, 0.03], [0.3, 0.6], [0.01, 0.02, 0.6], [0.1, 0.2, 0.3, 0.9])
SIGMA = np.array([0.001, 0.02, 0.001, 0.03, 0.05, 0.001, 0.002, 0.003, 0.02, 0.03, 0.04])


def recovery(status: Status, sigma: np.ndarray = SIGMA, body: Superquadric = BODY, as_hull: bool = False):
    fit = Fit(body, 0.001, status, "", covariance=np.diag(np.square(sigma)), as_hull=as_hull)
    return FrameRecovery((Recovery(fit, 0.9, 7, 100),), {}, np.zeros((48, 64), np.int32), None, "")


def array(found: publication.Identified):
    return publication.superquadric_array(found, is_cube=False)


def test_a_message_of_a_body_that_tapers_encloses_it_without_the_taper_and_is_it_with(rng):
    tapered = Superquadric(BODY.size, BODY.shape, BODY.translation, BODY.rotation, [0.4, -0.2])
    shown = array(publication.identify(recovery(Status.CONVERGED, body=tapered)))
    read = Superquadric(shown.size, shown.shape, shown.translation, shown.rotation)
    surface = tapered.sample_surface(500, rng)
    assert (read[0].gauge(surface) < 1 + 1e-6).all()
    np.testing.assert_allclose(publication.superquadrics(shown)[0].gauge(surface), 1.0, atol=1e-5)


def test_a_weak_body_names_the_axis_that_is_open():
    """0.02 of 0.04 m along y; a body that converged or failed gives no reason."""
    (reason,) = array(publication.identify(recovery(Status.WEAK))).reason
    assert Reason(int(reason)) == Reason.OPEN_Y
    (reason,) = array(publication.identify(recovery(Status.WEAK, as_hull=True))).reason
    assert Reason(int(reason)) == Reason.OPEN_Y | Reason.HULL
    cavity = Cavity(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.full(2, 0.03), 0.05, True)
    (open_vessel,) = recovery(Status.CONVERGED).bodies
    found = replace(recovery(Status.CONVERGED), bodies=(replace(open_vessel, cavity=cavity),))
    assert array(publication.identify(found)).reason == [Reason.CAVITY]
    for status in (Status.CONVERGED, Status.FAILED):
        assert array(publication.identify(recovery(status))).reason == [0]


def test_the_axis_is_named_as_the_published_body_names_it():
    """The track knows the open size from other views and has x and y exchanged: the frame's reason is about its x."""
    forms = BODY.equivalent_forms()
    exchanged = next(form for form in forms if form.size[0] == BODY.size[1])
    track = Followed(3, 9, True, exchanged, np.diag(np.square(SIGMA)) / 100)
    shown = array(publication.identify(recovery(Status.WEAK), [track]))
    assert (shown.status, shown.reason) == ([WEAK], [Reason.OPEN_X])
    np.testing.assert_allclose(shown.sigma_size[0], SIGMA[:3] / 10, rtol=1e-6)
    failed = array(publication.identify(recovery(Status.FAILED), []))
    assert (failed.status, failed.reason) == ([FAILED], [0])


def test_deviations_are_along_and_about_the_axes_of_the_body():
    """x of the body is y of the camera: what is unsure along y of the camera is so along x of the body."""
    turned = Superquadric(BODY.size, BODY.shape, BODY.translation, [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    shown = array(publication.identify(recovery(Status.CONVERGED, body=turned)))
    np.testing.assert_allclose(shown.sigma_shape, [[0.03, 0.05]], rtol=1e-6)
    np.testing.assert_allclose(shown.sigma_centre, [[0.002, 0.001, 0.003]], rtol=1e-6)
    np.testing.assert_allclose(shown.sigma_turn, [[0.02, 0.03, 0.04]], rtol=1e-6)
    moved = poses.move(shown, np.array([0.3, 0.1, 0.2, 0.9]), np.array([1.0, 2.0, 3.0]))
    for column in ("sigma_size", "sigma_shape", "sigma_centre", "sigma_turn", "reason"):
        np.testing.assert_array_equal(getattr(moved, column), getattr(shown, column))


def test_what_a_method_does_not_know_is_not_claimed_and_the_truth_is_sure_of_everything():
    unknown = array(publication.identify(recovery(Status.CONVERGED, np.full(11, np.nan))))
    for truth in (publication.truth_array(Superquadric.stack([BODY] * count)) for count in (0, 3)):
        for column in ("sigma_size", "sigma_shape", "sigma_centre", "sigma_turn"):
            assert np.isnan(getattr(unknown, column)).all(), column
            assert not getattr(truth, column).any(), column


PLACES = np.array([[0.0, 0.0, 0.6], [0.1, 0.0, 0.6]])


def of_two_parts():
    """An object of two balls of 4 and 2 cm, and one that is a body alone."""
    placed = zip((0.04, 0.02), PLACES, strict=True)
    balls = [Superquadric(np.full(3, radius), [1.0, 1.0], at, [0.0, 0.0, 0.0, 1.0]) for radius, at in placed]
    known = zip(balls, (Status.CONVERGED, Status.WEAK), strict=True)
    fits = [Fit(ball, 0.002, status, "", covariance=np.eye(11) * 1e-6) for ball, status in known]
    frame = recovery(Status.CONVERGED)
    (body,) = frame.bodies
    made = Recovery(body.fit, 0.9, 7, 100, parts=Parts.of(fits, np.array([0.7, 0.3]), 0.001, 1.0))
    return FrameRecovery((made, Recovery(body.fit, 0.8, 9, 90)), {}, frame.labels, None, "")


@pytest.mark.parametrize("is_tracked", [False, True])
def test_parts_follow_the_objects_in_the_cloud_and_share_their_ids(is_tracked):
    frame = of_two_parts()
    followed = [Followed(k, 5, True, BODY, np.diag(np.square(SIGMA))) for k in (31, 32)] if is_tracked else None
    found = publication.findings(publication.identify(frame, followed), Header(), is_cube=False)
    read = superquadrics.from_message(superquadrics.to_message(found.cloud, Header()))
    first, second = (31, 32) if is_tracked else (7, 9)
    assert (read.id.tolist(), read.part.tolist()) == ([first, second, first, first], [0, 0, 1, 2])
    assert read.label.tolist() == [7, 9, 7, 7]
    assert read.recovered.id.tolist() == found.shown_ids == [first, second]
    parts = read.parts_of(first)
    np.testing.assert_allclose(parts.size, [[0.04] * 3, [0.02] * 3], rtol=1e-6)
    np.testing.assert_allclose(parts.sigma_size, 1e-3, rtol=1e-6)
    assert parts.status.tolist() == [0, 1]
    assert np.isnan(parts.score).all()
    assert not len(read.parts_of(second))


def test_parts_move_with_their_objects_and_are_drawn_in_their_place():
    """Turned by a quarter about z and shifted; one marker an object, of both balls, and no vertex off them."""
    found = publication.findings(publication.identify(of_two_parts()), Header(), is_cube=False)
    turn, shift = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]), np.array([0.0, 0.0, -0.6])
    moved = found.move("base", turn, shift)
    places = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    np.testing.assert_allclose(moved.parts.translation, places, atol=1e-6)
    surfaces = [each for each in moved.markers().markers if each.ns.endswith("surface")]
    assert [each.id for each in surfaces] == [7, 9]
    vertices = np.array([[point.x, point.y, point.z] for point in surfaces[0].points])
    far = np.linalg.norm(vertices[:, None] - places, axis=2)
    of_first = far[:, 0] < far[:, 1] + 0.02
    np.testing.assert_allclose(np.where(of_first, far[:, 0], far[:, 1]), np.where(of_first, 0.04, 0.02), atol=1e-5)
    assert 0 < np.count_nonzero(of_first) < len(vertices)
