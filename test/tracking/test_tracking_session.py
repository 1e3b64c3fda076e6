"""Tracking sessions: whose numbers are published, in which frame and form, and counted; views of several cameras."""

import numpy as np
import pytest
from tracked_bodies import (
    CAMERA,
    Seen,
    angle_between,
    body,
    draw,
    error_of,
    exchanged,
    from_camera,
    image_of,
    looking_at,
    nees,
    noise,
    spread_bodies,
)

from sq_perception import Recoverer, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.recovery.cavities import Cavity
from sq_perception.simulation.scenes import table_scene
from sq_perception.simulation.sensor_noise import preset
from sq_perception.tracking import association, state
from sq_perception.tracking.session import Tally, TrackingSession
from sq_perception.tracking.tracker import Tracker
from sq_perception.tracking.views import View, fuse_views


def test_numbers_are_those_of_the_tracks_in_the_optical_frame(rng):
    """A camera that goes about four bodies: what comes out is what a tracker has, seen from the camera."""
    truths, one, other = spread_bodies(4, rng), TrackingSession(), Tracker()
    for k in range(8):
        pose = looking_at(truths.translation.mean(axis=0), np.array([np.sin(0.3 * k), 0.2, -np.cos(0.3 * k)]), 2.0)
        seen = [from_camera(draw(t, noise(), rng), *pose) for t in truths]
        followed = one.follow(seen, 0.1 * k, pose)
        tracks = other.update(seen, 0.1 * k, pose)
        assert [f.id for f in followed] == [1, 2, 3, 4]
        assert all(f.is_fused and f.seen == k + 1 for f in followed)
        for found, track in zip(followed, tracks, strict=True):
            back = from_camera(Seen(track.superquadric, track.covariance), *pose)
            difference = state.difference(back.superquadric.to_flat(), found.superquadric.to_flat())
            np.testing.assert_allclose(difference, 0, atol=1e-9)
            np.testing.assert_allclose(found.covariance, back.covariance, atol=1e-12)
            np.testing.assert_allclose(found.sigma_size, track.sigma_size)
    raw = [np.abs(np.log(s.superquadric.volume() / t.volume())) for s, t in zip(seen, truths, strict=True)]
    fused = [np.abs(np.log(f.superquadric.volume() / t.volume())) for f, t in zip(followed, truths, strict=True)]
    assert np.mean(fused) < np.mean(raw)


def test_a_cavity_is_kept_while_nothing_looks_into_it_and_forgotten_when_it_is_closed():
    truth = body()
    axis, rim = truth.rotation_matrix[:, 2], truth.translation + 0.03 * truth.rotation_matrix[:, 2]
    above = looking_at(truth.translation, axis, 1.0)
    beside = looking_at(truth.translation, truth.rotation_matrix[:, 0], 1.0)
    one, found = TrackingSession(), []
    for k, (pose, is_shown) in enumerate([(above, True), (beside, False), (above, False), (beside, False)]):
        matrix = quaternions.to_matrix(pose[0])
        shown = Cavity((rim - pose[1]) @ matrix, axis @ matrix, np.array([0.04, 0.05]), 0.02, True)
        seen = from_camera(Seen(truth, noise()), *pose)._replace(cavity=shown if is_shown else None)
        found.append(one.follow([seen], 0.1 * k, pose)[0].cavity)
        if k < 2:
            np.testing.assert_allclose(found[k].rim, shown.rim, atol=1e-6)
            np.testing.assert_allclose(found[k].axis, shown.axis, atol=1e-6)
    assert found[2:] == [None, None]


def test_a_body_that_tapers_does_so_in_whichever_form_it_is_seen(rng):
    straight = body()
    truth = Superquadric(straight.size, straight.shape, straight.translation, straight.rotation, [0.4, -0.2])
    points = truth.translation + rng.uniform(-0.06, 0.06, (50, 3))
    one = TrackingSession()
    for k, form in enumerate(truth.equivalent_forms()):
        (found,) = one.follow([Seen(form, noise())], 0.1 * k)
        assert found.is_fused
        np.testing.assert_allclose(found.superquadric.gauge(points), truth.gauge(points), rtol=1e-6)


def test_a_body_moved_by_a_hand_is_never_published_where_it_was(rng):
    """3 cm, then 8 cm, then a quarter turn: in the very frame of the motion the observation itself comes out."""
    one, truth = TrackingSession(), body()
    for k in range(40):
        if k == 10:
            truth = Superquadric(truth.size, truth.shape, truth.translation + [0.03, 0, 0], truth.rotation)
        if k == 20:
            truth = Superquadric(truth.size, truth.shape, truth.translation + [0, 0.08, 0], truth.rotation)
        if k == 30:
            truth = body(centre=truth.translation, turn=(0.1, 1.0, 0.3))
        seen = draw(truth, noise(), rng)
        (found,) = one.follow([seen], 0.1 * k)
        assert found.id == 1
        assert np.linalg.norm(found.superquadric.translation - truth.translation) < 0.006
        assert min([angle_between(found.superquadric, form) for form in truth.equivalent_forms()]) < 0.2
        if k in (10, 30):
            assert not found.is_fused
            points = seen.superquadric.translation + rng.uniform(-0.06, 0.06, (50, 3))
            np.testing.assert_allclose(found.superquadric.gauge(points), seen.superquadric.gauge(points), rtol=1e-9)


def test_what_spans_more_than_its_track_is_published_as_it_is_seen(rng):
    """A bowl in the place of a carton: of sizes so unsure that they might be the carton's, but nothing that small can
    be seen so wide.  What stays is seen to its ends, and fused."""
    carton, bowl = body((0.04, 0.03, 0.025)), body((0.1, 0.09, 0.06))
    unsure = state.scale_sizes(noise(0.3, 0.5, 0.05, 0.5), bowl.size)
    for spanned in (np.full(3, np.nan), np.array([0.9, 0.9, 0.5])):
        one = TrackingSession()
        for k in range(10):
            seen = draw(carton, noise(0.02, 0.03, 0.001, 0.02), rng)._replace(seen=np.ones(3))
            (found,) = one.follow([seen], 0.1 * k)
            assert found.is_fused
        (found,) = one.follow([Seen(bowl, unsure, seen=spanned)], 1.0)
        assert (found.id, found.is_fused) == (1, np.isnan(spanned).all())
    np.testing.assert_allclose(np.sort(found.superquadric.size), np.sort(bowl.size))
    np.testing.assert_allclose(np.sort(found.sigma_size), np.sort(0.3 * bowl.size))


def test_an_old_answer_counts_where_the_camera_was_corrected_and_after_a_pause(rng):
    """Still frames repeat an answer; then the map moves the camera by 4 cm: no body stays where the old pose had it. As
    when an arm was at work for some seconds: the pose was forgotten, and the image shows where the body is."""
    one, truth = TrackingSession(), body()
    seen = draw(truth, noise(), rng)
    for k in range(14):
        pose = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.04 * (k >= 8), 0.0, 0.0])
        (found,) = one.follow([seen._replace(repeats=k)], 0.2 * k, pose)
        off = found.superquadric.translation - seen.superquadric.translation
        assert np.linalg.norm(off) < 0.004, f"frame {k}"
    assert found.id == 1
    one, seen = TrackingSession(), draw(body(), noise(), rng)
    before, _, after = (one.follow([seen._replace(repeats=k)], stamp)[0] for k, stamp in enumerate((0.0, 0.2, 8.0)))
    known = [np.sqrt(np.diag(each.covariance)) for each in (before, after)]
    assert (known[1] > known[0] - 1e-9).all(), "an old answer says nothing new"
    assert (known[1][5:8] < 0.1).all()


def test_a_body_exchanged_for_another_is_published_late_by_one_frame_at_most(rng):
    """The same place and pose, other sizes: one such frame may be an error, the second one is believed."""
    one, old, new = TrackingSession(), body((0.05, 0.04, 0.03)), body((0.05, 0.04, 0.06))
    for k in range(30):
        truth = old if k < 10 else new
        (found,) = one.follow([draw(truth, noise(0.02, 0.03, 0.001, 0.02), rng)], 0.1 * k)
        if k != 10:
            np.testing.assert_allclose(np.sort(found.superquadric.size), np.sort(truth.size), rtol=0.1)
    assert found.id == 1
    assert found.is_fused


def test_frames_without_a_pose_leave_the_tracks_as_they_are(rng):
    """The camera goes 15 cm while its pose is lost, from one of two equal bodies to where the other one was."""
    one, truths = TrackingSession(), [body(centre=(x, 0.0, 1.0)) for x in (0.0, 0.15)]
    for k in range(60):
        position = np.array([min(0.15, 0.005 * max(k - 5, 0)), 0.0, 0.0])
        pose, is_known = (np.array([0.0, 0.0, 0.0, 1.0]), position), not 5 <= k < 40
        followed = one.follow(
            [from_camera(draw(t, noise(), rng), *pose) for t in truths], 0.033 * k, pose, is_pose_known=is_known
        )
        if is_known:
            assert [found.id for found in followed] == [1, 2], f"frame {k}"
            for found, truth in zip(followed, truths, strict=True):
                assert np.linalg.norm(found.superquadric.translation + position - truth.translation) < 0.006


def test_what_was_seen_before_the_first_pose_is_no_second_body(rng):
    one, truth = TrackingSession(), body()
    pose = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.5, 0.0, 0.0])
    before = [one.follow([draw(truth, noise(), rng)], 0.1 * k, pose, is_pose_known=False)[0].id for k in range(4)]
    after = [one.follow([draw(truth, noise(), rng)], 0.1 * k, pose)[0].id for k in range(4, 8)]
    assert before == [1] * 4
    assert after == [2] * 4, "an id is never used again"
    assert one.hidden == ()


def test_without_a_pose_there_are_ids_and_forms_but_no_fusion(rng):
    truth, one = body(), TrackingSession()
    last = None
    for k in range(20):
        seen = draw(truth, noise(), rng)
        (found,) = one.follow([seen], 0.1 * k, np.eye(4), is_pose_known=k < 5)
        assert (found.id, found.seen, found.is_fused) == (1, k + 1, k < 5)
        if k >= 5:
            assert sorted(found.superquadric.size) == pytest.approx(sorted(seen.superquadric.size), rel=1e-9)
            np.testing.assert_allclose(np.sort(found.sigma_size), np.sort(np.sqrt(np.diag(seen.covariance)[:3])))
        if last is not None:
            assert angle_between(found.superquadric, last) < 0.3
        last = found.superquadric
    assert one.tally == Tally(tracks=1, births=1, resets=0, without_pose=15)


EXCHANGES = range(association.EXACT, len(association.TURNS))


@pytest.mark.parametrize("turn", EXCHANGES)
@pytest.mark.parametrize("size", [(0.05, 0.04, 0.03), (0.04, 0.04, 0.04)])
def test_a_frame_without_pose_names_the_axes_as_the_track_does(turn, size, rng):
    """A fit that takes another axis as z: a grasp on the frame of tf must not turn by 90 degrees."""
    truth, one = body(size, (0.25, 0.35)), TrackingSession()
    for k in range(6):
        (last,) = one.follow([draw(truth, noise(), rng)], 0.1 * k)
    seen = exchanged(draw(truth, noise(), rng, form=0), turn)
    (found,) = one.follow([seen], 0.6, is_pose_known=False)
    assert not found.is_fused
    assert angle_between(found.superquadric, last.superquadric) < 0.3
    np.testing.assert_allclose(np.sort(found.superquadric.size), np.sort(seen.superquadric.size))
    np.testing.assert_allclose(found.superquadric.size, last.superquadric.size, rtol=0.2)
    assert np.isfinite(found.sigma_size).all()


@pytest.mark.parametrize("turn", EXCHANGES)
def test_a_body_that_is_found_elsewhere_keeps_the_names_of_its_axes(turn, rng):
    truth, one = body((0.05, 0.04, 0.03), (0.15, 0.6)), TrackingSession()
    for k in range(6):
        (last,) = one.follow([draw(truth, noise(), rng)], 0.1 * k)
    there = Superquadric(truth.size, truth.shape, truth.translation + [0.03, 0, 0], truth.rotation)
    (found,) = one.follow([exchanged(draw(there, noise(), rng, form=0), turn)], 0.6)
    assert not found.is_fused
    assert angle_between(found.superquadric, last.superquadric) < 0.3


@pytest.mark.parametrize(("deviation", "shown"), [(0.6, 0.0), (0.1, 0.7)])
def test_a_turn_that_the_image_leaves_open_is_that_of_the_track(deviation, shown):
    """0.7 radians about the axis of a can: chance where the fit says that it knows no better, and else a hand."""
    truth, one = body((0.04, 0.04, 0.03), (0.2, 0.95)), TrackingSession()
    covariance = noise(turn=0.01)
    one.follow([Seen(truth, state.scale_sizes(covariance, truth.size))], 0.0)
    error = np.zeros(11)
    error[10], covariance[10, 10] = 0.7, deviation**2
    turned = Superquadric.from_flat(state.add(truth.to_flat(), error))
    (found,) = one.follow([Seen(turned, state.scale_sizes(covariance, truth.size))], 0.1, is_pose_known=False)
    assert angle_between(found.superquadric, truth) == pytest.approx(shown, abs=0.02)
    np.testing.assert_allclose(found.superquadric.size, truth.size)


@pytest.mark.parametrize("height", [0.03, 0.06])
def test_a_can_that_is_tipped_over_stays_a_can(height, rng):
    """Sizes and exponents are those of the track about another axis: it has been turned, and is shown as it is."""
    truth, one = body((0.03, 0.03, height), (0.1, 1.0), turn=(0.0, 0.0, 0.0)), TrackingSession()
    for k in range(6):
        one.follow([draw(truth, noise(), rng)], 0.1 * k)
    seen = draw(body(truth.size, truth.shape, turn=(np.pi / 2, 0.0, 0.0)), noise(), rng)
    (found,) = one.follow([seen], 0.6, is_pose_known=False)
    points = seen.superquadric.translation + rng.uniform(-0.06, 0.06, (50, 3))
    np.testing.assert_allclose(found.superquadric.gauge(points), seen.superquadric.gauge(points), rtol=1e-9)


@pytest.mark.parametrize("is_pose_known", [True, False])
def test_time_that_goes_back_to_between_frames_with_and_without_a_pose_resets(is_pose_known, rng):
    """A pose at 10 s, none at 20 s, and then 15 s: before the last frame, though not before the last pose."""
    one, seen = TrackingSession(), draw(body(), noise(), rng)
    one.follow([seen], 10.0)
    one.follow([seen], 20.0, is_pose_known=False)
    (found,) = one.follow([seen], 15.0, is_pose_known=is_pose_known)
    (later,) = one.follow([seen], 16.0)
    assert (found.id, found.seen, one.tally.resets) == (2, 1, 1)
    assert (later.id, later.seen) == ((2, 2) if is_pose_known else (3, 1))


def test_time_that_goes_back_resets_and_ids_go_on(rng):
    one = TrackingSession()
    ids = [one.follow([draw(body(), noise(), rng)], stamp)[0].id for stamp in (5.0, 5.1, 5.1, 2.0, 2.1)]
    assert ids == [1, 1, 1, 2, 2]
    assert one.tally == Tally(tracks=1, births=2, resets=1)
    one.reset()
    assert one.tally == Tally(tracks=0, births=2, resets=1)
    assert one.follow([draw(body(), noise(), rng)], 1.0)[0].id == 3
    assert one.tally.resets == 1


def test_every_body_of_a_frame_has_a_track_and_nothing_else_comes_out(rng):
    one = TrackingSession()
    near, far = body(), body(centre=(0.3, 0, 0.8))
    assert [f.id for f in one.follow([draw(near, noise(), rng), draw(far, noise(), rng)], 0.0)] == [1, 2]
    assert [f.id for f in one.follow([draw(far, noise(), rng)], 0.1)] == [2]
    assert one.follow([], 0.2) == ()
    assert one.tally.births == 2


def test_what_a_fit_does_not_know_a_track_does_not_claim():
    """A method without covariance: numbers are fused, deviations stay unknown."""
    one, unknown = TrackingSession(), np.full((11, 11), np.nan)
    for k, size in enumerate((0.050, 0.052)):
        (found,) = one.follow([Seen(body((size, 0.04, 0.03)), unknown)], 0.1 * k)
    assert found.is_fused
    assert 0.0502 < found.superquadric.size.max() < 0.0518
    assert np.isnan(found.sigma_size).all()
    (found,) = one.follow([Seen(body((0.05, 0.04, 0.03)), unknown)], 0.2, is_pose_known=False)
    assert np.isnan(found.covariance).all()


def test_misuse_changes_nothing(rng):
    one = TrackingSession()
    one.follow([draw(body(), noise(), rng)], 0.0)
    before = one.tally
    with pytest.raises(ValueError, match="stamp"):
        one.follow([], np.nan)
    with pytest.raises(ValueError, match="rigid"):
        one.follow([], 1.0, 2 * np.eye(4))
    assert one.tally == before


FRAMES = 13


@pytest.fixture(scope="module")
def recoverer():
    return Recoverer()


@pytest.mark.parametrize(("seed", "has_masks"), [(5, True), (6, False), (15, False)])
def test_axes_keep_their_names_in_a_still_scene(recoverer, seed, has_masks):
    """Round bodies, whose turn no image tells, and boxes and ovals, of which fits take now this axis as z, now that."""
    scene, noise = table_scene(np.random.default_rng(seed), 5), preset("realsense_d435")
    rng = np.random.default_rng([seed, 1])
    depth, labels = scene.render()
    sessions = {"tracked": TrackingSession(), "by themselves": TrackingSession()}
    last, own_turns = {}, 0
    for k in range(FRAMES):
        image = noise.measure(depth, scene.camera, rng)
        seen = recoverer.recover(image, scene.camera, labels if has_masks else None).recovered
        for name, session in sessions.items():
            is_pose_known = name == "tracked" or k == 0
            for one, raw in zip(session.follow(seen, k / 30, is_pose_known=is_pose_known), seen, strict=True):
                before = last.get((name, one.id), one.superquadric)
                assert angle_between(before, one.superquadric) < np.pi / 4, (name, k, one.id)
                last[name, one.id] = one.superquadric
                own = [angle_between(before, form) for form in raw.superquadric.equivalent_forms()]
                own_turns += min(own) > np.pi / 4
    assert own_turns, "without a track axes change places"


def unsure_along(truth, direction, deviation=0.2):
    """The covariance, sizes as shares, of a look from a direction that hardly tells the extent along itself."""
    along = np.abs(truth.rotation_matrix.T @ direction) / np.linalg.norm(direction)
    return noise(0.02, 0.03, 0.001, 0.02) + np.diag(np.r_[(deviation * along) ** 2, np.zeros(8)])


def test_two_cameras_across_each_other_leave_no_size_open(rng):
    truth = body(turn=(0, 0, 0))
    views = []
    for direction in (np.array([0.0, 0, -1]), np.array([1.0, 0, 0])):
        pose = looking_at(truth.translation, direction, 0.8)
        views.append(View([from_camera(draw(truth, unsure_along(truth, direction), rng), *pose)], pose))
    (one,), (other,), (both,) = fuse_views(views[:1]), fuse_views(views[1:]), fuse_views(views)
    assert both.seen == 2
    relative = [np.sort(each.sigma_size / each.superquadric.size) for each in (one, other, both)]
    assert relative[0][2] > 0.15
    assert relative[1][2] > 0.15
    assert relative[2][2] < 0.05
    assert nees(both, truth) < 40
    assert np.abs(error_of(both, truth)[0][:3]).max() < 0.1


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_every_body_is_there_once_whoever_sees_it(order, rng):
    """The third camera sees but one of two bodies: a wall hides the other one from it."""
    assert fuse_views([]) == ()
    truths = spread_bodies(2, rng)
    wall = Superquadric([0.15, 0.3, 0.01], [0.1, 0.1], [0.3, 0.0, 0.4], [0, 0, 0, 1.0])
    views = []
    for number, x in enumerate((-0.4, 0.4, 0.15)):
        pose = looking_at(truths.translation.mean(axis=0), np.array([x, 0.05, -1.0]), 0.9)
        shown = truths if number < 2 else truths[:1]
        bodies = [from_camera(draw(each, noise(), rng), *pose) for each in shown]
        scene = [*truths, wall] if number == 2 else truths
        local = [from_camera(Seen(each, np.eye(11)), *pose).superquadric for each in scene]
        views.append(View(bodies, pose, CAMERA, image_of(local, 3.0)))
    tracks = fuse_views(views[k] for k in order)
    assert sorted(track.seen for track in tracks) == [2, 3]
    for truth in truths:
        (track,) = (each for each in tracks if np.linalg.norm(each.superquadric.translation - truth.translation) < 0.05)
        assert np.linalg.norm(state.difference(truth.to_flat(), track.superquadric.to_flat())[5:8]) < 0.01
