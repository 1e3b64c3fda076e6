"""Grasps whose best is known in closed form; what makes one impossible; and a plan's invariances."""

from dataclasses import replace

import numpy as np
import pytest

from sq_perception import Camera, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping import clearance, surroundings
from sq_perception.grasping.closing import KnownBodies
from sq_perception.grasping.gripper import GRIPPERS, PANDA, Gripper, gripper
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.grasping.trials import Trials
from sq_perception.imaging import raycast

TABLE = np.array([0.0, 0.0, 1.0, 0.0])
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
ON_TABLE = Surroundings(plane=TABLE)
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
SPHERE = ([0.03, 0.03, 0.03], [1.0, 1.0])
CAN = ([0.033, 0.033, 0.06], [0.1, 1.0])
BOX = ([0.05, 0.02, 0.06], [0.1, 0.1])


def standing(size, shape, x=0.0, y=0.0):
    return Superquadric(size, shape, [x, y, size[2]], UPRIGHT)


def sure(count, sigma=0.001):
    """Covariances of bodies that are known to ``sigma`` metres and 0.01 radians."""
    one = np.diag([sigma**2] * 3 + [1e-4] * 2 + [sigma**2] * 3 + [1e-4] * 3)
    return np.repeat(one[None], count, axis=0)


def plan(*bodies, hand=PANDA, around=ON_TABLE, covariance=None, **more):
    covariance = sure(len(bodies)) if covariance is None else covariance
    return grasps(Superquadric.stack(list(bodies)), hand, covariance, around, **more)


def closing_line(grasp):
    return quaternions.to_matrix(grasp.rotation)[:, 1]


@pytest.mark.parametrize(("size", "shape"), [SPHERE, CAN, BOX])
def test_reach_and_chord_agree_with_the_body(size, shape):
    body = Superquadric.stack([Superquadric(size, shape, [0.1, 0.2, 0.3], [0.3, -0.2, 0.5, 0.7])])
    directions = np.random.default_rng(1).standard_normal((40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    owner = np.zeros(40, dtype=int)
    known = KnownBodies.of(body, sure(1))
    reach, _ = known.reaches(owner, directions)
    np.testing.assert_allclose(reach, body[0].support(directions), rtol=1e-9)
    offset = 0.2 * np.array(size).min() * directions[::-1]
    ends, angle = known.chords(owner, offset, directions)
    for side, sign in ((0, 1), (1, -1)):
        points = body[0].translation + offset + sign * ends[:, side, None] * directions
        np.testing.assert_allclose(body[0].gauge(points), 1.0, atol=2e-2)
    assert np.isfinite(angle).all()


def test_the_sigma_of_a_reach_is_that_of_disturbed_bodies():
    rng = np.random.default_rng(2)
    body = Superquadric.stack([Superquadric([0.05, 0.03, 0.02], [0.4, 0.8], [0.1, 0.0, 0.5], [0.1, 0.4, 0.2, 0.8])])
    spread = np.diag(np.array([2, 1, 3, 0, 0, 2, 2, 4, 30, 20, 10]) ** 2 * 1e-6)[None]
    directions = quaternions.to_matrix(body.rotation)[0].T @ np.eye(3)
    _, sigma = KnownBodies.of(body, spread).reaches(np.zeros(3, dtype=int), directions)
    step = rng.standard_normal((20000, 11)) * np.sqrt(np.diag(spread[0]))
    turn = quaternions.multiply(body.rotation, quaternions.from_rotation_vector(step[:, 8:]))
    many = Superquadric(body.size + step[:, :3], body.shape, body.translation + step[:, 5:8], turn)
    reach = many.support(directions) + many.translation @ directions.T
    np.testing.assert_allclose(sigma, reach.std(axis=0), rtol=0.05)


def test_a_sphere_is_taken_through_its_middle_and_a_can_across_its_axis():
    best = plan(standing(*SPHERE)).grasps[0]
    np.testing.assert_allclose(best.position, [0, 0, 0.03], atol=1e-3)
    assert best.width == pytest.approx(0.06)
    assert best.width < best.opening <= PANDA.opening
    assert best.score > 0.95
    found = plan(standing(*CAN)).grasps
    assert all(abs(closing_line(grasp)[2]) < 0.3 for grasp in found)
    assert found[0].width == pytest.approx(0.066, rel=1e-3)
    np.testing.assert_allclose(found[0].position[:2], 0, atol=1e-3)


def test_fingers_mind_no_width_that_they_do_not_come_down_to():
    """78 of 80 mm wide: a can all the way, a dome only where its middle is, 6 cm below the fingers' ends."""
    can, dome = (standing([0.039, 0.039, 0.1], [shape, 1.0]) for shape in (0.1, 1.0))
    assert plan(can).grasps[0].score < 0.8 < plan(dome).grasps[0].score


def test_a_box_is_taken_across_its_narrow_sides_and_along_them():
    found = plan(standing(*BOX)).grasps
    for grasp in found:
        np.testing.assert_allclose(np.abs(closing_line(grasp)), [0, 1, 0], atol=0.3)
        assert grasp.width == pytest.approx(0.04, abs=0.012)
    assert np.ptp([grasp.position[0] for grasp in found]) > 0.02


def test_the_gripper_stands_off_the_body_and_the_table():
    for body in (standing(*SPHERE), standing(*CAN), standing(*BOX)):
        for grasp in plan(body).grasps:
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            for box in PANDA.boxes(grasp.opening):
                inside = grasp.to_body_frame(box[:3] + np.random.default_rng(0).uniform(-1, 1, (500, 3)) * box[3:])
                assert body.gauge(inside).min() > 1.0
                assert grasp.to_body_frame(box[:3] + corners * box[3:])[:, 2].min() > 0.0


def test_what_is_wider_than_the_opening_or_behind_the_support_has_that_for_a_reason():
    """Also where it is too wide; what looks out of the plane only in part is in the table's way."""
    found = plan(standing([0.041] * 3, [0.1, 0.1]), standing(*SPHERE, x=0.3))
    assert not found.of(0)
    assert "wider than the opening of 80 mm" in found.reasons[0]
    assert found.of(1)
    assert found.reasons[1] == ""
    sunk = Superquadric(*CAN, [0.5, 0.0, -0.055], UPRIGHT)
    behind = Superquadric(*CAN, [0.0, 0.0, -0.07], UPRIGHT)
    wide = Superquadric([0.1] * 3, [1, 1], [1, 0, -0.2], UPRIGHT)
    reasons = plan(behind, wide, sunk, standing(*CAN, y=0.5)).reasons
    assert reasons[:2] == ("behind the plane that bodies stand on",) * 2
    assert reasons[2].startswith("no way for the fingers")
    assert reasons[3] == ""


def test_what_no_pad_meets_squarely_has_friction_for_a_reason_with_which_the_score_falls():
    """A low pebble, 6 cm long and 2.4 cm high: the fingers can come, and would slip off its slopes."""
    pebble = standing([0.023, 0.031, 0.012], [1.7, 0.7])
    assert plan(pebble, friction=0.4).reasons == ("nothing holds: friction",)
    scores = [plan(standing(*CAN), friction=mu).grasps[0].score for mu in (0.2, 0.4, 0.8)]
    assert scores == sorted(scores)


def test_masked_readings_hide_nothing_and_millimetres_are_refused():
    camera = Camera(100, 100, 100.0, 100.0, 49.5, 49.5)
    is_near = np.zeros((100, 100), bool)
    is_near[40:60, 40:60] = True
    depth = np.ma.masked_array(np.where(is_near, 1.0, 2.0), is_near)
    assert Surroundings.of_image(depth, camera, None).points[:, 2].min() == 2.0
    assert np.isnan(Surroundings(depth=depth, camera=camera).beyond(np.array([0.0, 0.0, 1.5])))
    millimetres = np.full((100, 100), 2000, np.uint16)
    with pytest.raises(ValueError, match="depth: expected a float image"):
        Surroundings.of_image(millimetres, camera, None)
    with pytest.raises(ValueError, match="depth: expected a float image"):
        Surroundings(depth=millimetres, camera=camera)


def test_no_more_points_are_kept_than_are_promised_and_from_everywhere():
    camera = Camera(100, 100, 100.0, 100.0, 49.5, 49.5)
    points = Surroundings.of_image(np.full((100, 100), 2.0), camera, None).points
    assert len(points) == surroundings._MOST
    for quarter in (points[:, 0] < 0, points[:, 1] < 0):
        assert quarter.mean() == pytest.approx(0.5, abs=0.01)


def test_an_uncertain_width_is_given_room_and_believed_less_and_one_that_may_be_less_is_tried():
    known = plan(standing(*BOX)).grasps[0]
    vague = plan(standing(*BOX), covariance=sure(1, sigma=0.012)).grasps[0]
    assert vague.opening > known.opening
    assert vague.score < known.score
    wide = standing([0.041, 0.041, 0.05], [0.1, 0.1])
    assert not plan(wide).grasps
    found = plan(wide, covariance=sure(1, sigma=0.015)).grasps
    assert found
    assert found[0].score < 0.5


def test_the_hand_stands_farther_from_the_side_that_is_less_sure():
    """Size and place along y fall together: the side along +y is sure to 1 mm, the other one to 6 mm."""
    spread = sure(1, sigma=1e-5)
    half, place = 0.5 * (0.001**2 + 0.006**2), 0.5 * (0.001**2 - 0.006**2)
    spread[0][np.ix_([1, 6], [1, 6])] = 0.5 * np.array([[half, place], [place, half]])
    planned = plan(standing([0.05, 0.015, 0.06], [0.1, 0.1]), covariance=spread, placement=0.0).grasps
    found = [grasp for grasp in planned if abs(closing_line(grasp)[1]) > 0.99]
    assert found
    for grasp in found:
        assert grasp.opening == pytest.approx(0.03 + (0.005 + 2 * 0.001) + (0.005 + 2 * 0.006), abs=2e-4)
        assert grasp.position[1] == pytest.approx(-0.5 * 2 * (0.006 - 0.001), abs=2e-4)


def test_the_error_of_the_hand_adds_to_that_of_the_sides():
    body = standing([0.05, 0.015, 0.06], [0.1, 0.1])
    best = {sigma: plan(body, placement=sigma).grasps[0] for sigma in (0.0, 0.002, 0.006)}
    assert best[0.006].score < best[0.002].score
    side = 0.5 * (0.5 * (best[0.0].opening - 0.03) - 0.005)
    for sigma, grasp in best.items():
        assert grasp.opening == pytest.approx(0.03 + 2 * (0.005 + 2 * np.hypot(side, sigma)), abs=5e-4)


def hammer(half_head=0.06):
    """A hammer on the table: the body around it, its handle along x and its head across the end."""
    handle = Superquadric([0.09, 0.014, 0.014], [0.2, 0.2], [0.0, 0.0, 0.02], UPRIGHT)
    head = Superquadric([0.02, half_head, 0.02], [0.2, 0.2], [0.11, 0.0, 0.02], UPRIGHT)
    return Superquadric([0.11, half_head, 0.02], [0.2, 0.2], [0.02, 0.0, 0.02], UPRIGHT), handle, head


def test_what_is_too_wide_is_taken_by_its_handle_near_its_middle():
    body, handle, head = hammer()
    assert not plan(body).grasps
    found = plan(body, handle, head, things=np.zeros(3, int))
    assert found.reasons == ("",)
    assert {grasp.body for grasp in found.grasps} == {0}
    best = found.grasps[0]
    assert abs(plan(handle).grasps[0].position[0]) < 0.01
    assert best.position[0] > 0.025  # nearer to the middle of all of its mass
    assert best.position[0] + 0.5 * PANDA.finger_width < head.translation[0] - head.size[0]
    assert abs(closing_line(best)[1]) > 0.9


def test_the_body_around_parts_is_in_nobodys_way():
    """A ball stands in the corner of a hammer, where the body around the hammer is and none of its parts."""
    body, handle, head = hammer()
    ball = standing([0.015] * 3, [1.0, 1.0], x=-0.01, y=0.055)
    things = np.array([0, 1, 0, 0])
    assert {grasp.body for grasp in plan(body, ball).grasps} == set()
    assert {grasp.body for grasp in plan(body, ball, handle, head, things=things).grasps} == {0, 1}


@pytest.mark.parametrize("things", [[0, 0], [0, 2, 2], [1, 1, 1], [0.0, 0.0, 0.0]])
def test_parts_of_no_thing_are_refused(things):
    with pytest.raises(ValueError, match="things: expected"):
        plan(*hammer(), things=np.array(things))


def test_gaps_to_spheres_and_depths_of_points():
    """One finger-sized box at the origin: the gap to a sphere is known along any axis, a point's depth inside too."""
    frame = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)[None]
    box = np.array([[[0.0, 0.0, 0.0, 0.01, 0.02, 0.03]]])
    for way, half in ((np.array([1.0, 0, 0]), 0.01), (np.array([0, -1.0, 0]), 0.02), (np.array([0, 0.6, 0.8]), None)):
        corner = np.array([0.0, 0.02, 0.03]) if half is None else half * way
        ball = Superquadric.stack([Superquadric([0.02] * 3, [1.0, 1.0], corner + 0.03 * way, UPRIGHT)])
        known = ball.to_flat(), np.ascontiguousarray(ball.rotation_matrix), np.zeros(1, int)
        gap, which, found = clearance.gaps_to_bodies(frame, box, np.array([-1]), *known)
        assert which[0] == 0
        assert gap[0] == pytest.approx(0.01, abs=1e-4)
        np.testing.assert_allclose(found[0], way, atol=1e-6)
    for x in (0.004, 0.012):
        points = np.tile([x, 0.0, 0.0], (4, 1))
        assert clearance.gaps_to_points(frame, box, points)[0] == pytest.approx(x - 0.01)


def test_a_body_of_unknown_depth_is_taken_by_its_known_sides():
    doubtful = sure(1)
    doubtful[0, 0, 0] = 0.02**2  # along x; y is as narrow
    found = plan(standing([0.025, 0.025, 0.05], [0.1, 0.1]), covariance=doubtful).grasps
    assert all(abs(closing_line(grasp)[1]) > 0.9 for grasp in found)


def test_what_is_known_of_a_body_counts_though_not_all_is():
    """A cloud of an older version has no deviations of the turn: those of the sizes are believed all the same."""
    body, vague = standing(*BOX), sure(1, sigma=0.03)
    for unknown in ([8, 9, 10], [2], range(5, 8)):
        part = vague.copy()
        part[:, unknown] = part[:, :, unknown] = np.nan
        scores = [plan(body, covariance=each).grasps[0].score for each in (part, np.full_like(vague, np.nan))]
        assert scores[0] < scores[1]
    unknown = (KnownBodies.of(Superquadric.stack([body]), each) for each in (np.full((1, 11, 11), np.nan), None))
    np.testing.assert_array_equal(*(each.covariance for each in unknown))


def test_a_long_heavy_body_is_taken_near_its_middle():
    found = plan(Superquadric([0.14, 0.03, 0.03], [0.1, 0.1], [0.0, 0.0, 0.03], UPRIGHT))
    assert abs(found.grasps[0].position[0]) < 0.03


def test_fingers_do_not_go_between_bodies_that_touch():
    side = [0.02, 0.02, 0.05], [0.1, 0.1]
    found = plan(standing(*side, x=0.0), standing(*side, x=0.042))
    assert found.grasps
    for grasp in found.grasps:
        assert abs(closing_line(grasp)[1]) > 0.9


def test_points_of_no_body_are_kept_clear_of_and_a_bodys_own_say_nothing_new():
    wall = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 41), [0.03], np.linspace(0, 0.3, 61)), axis=-1).reshape(-1, 3)
    body = standing([0.03, 0.02, 0.05], [0.1, 0.1])
    assert any(abs(closing_line(grasp)[1]) > 0.9 for grasp in plan(body).grasps)
    found = plan(body, around=Surroundings(TABLE, wall))
    assert all(abs(closing_line(grasp)[1]) < 0.3 for grasp in found.grasps)
    way = np.random.default_rng(4).standard_normal((600, 3))
    points = body.translation + 0.1 * way / body.gauge(body.translation + 0.1 * way)[:, None]
    seen = Surroundings(TABLE, points[points[:, 2] > 0.01])
    assert plan(body, around=seen).grasps[0].score == pytest.approx(plan(body).grasps[0].score, rel=1e-6)


def test_space_that_nobody_saw_makes_a_grasp_less_sure():
    body = Superquadric(*SPHERE, [0.0, 0.0, 0.6], UPRIGHT)
    free = plan(body, around=Surroundings()).grasps[0].score
    seen = np.full((48, 64), 1.0)
    assert plan(body, around=Surroundings(depth=seen, camera=CAMERA)).grasps[0].score >= free
    hidden = np.full((48, 64), 0.5)
    assert plan(body, around=Surroundings(depth=hidden, camera=CAMERA)).grasps[0].score < 0.95 * free


def test_a_vague_side_is_where_the_image_shows_it():
    """The same body, known to a centimetre, and images of three: fingers pass what is there, not what might be."""
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    size, shape = [0.03, 0.06, 0.06], [0.1, 0.1]
    body, spread = Superquadric(size, shape, [0.0, 0.0, 0.6], UPRIGHT), sure(1, sigma=0.012)
    scores = []
    for half in (0.02, 0.03, 0.06):
        depth, _ = raycast.render(Superquadric([half, *size[1:]], shape, [0.0, 0.0, 0.6], UPRIGHT), camera)
        around = Surroundings.of_image(np.minimum(depth, 1.0), camera, np.array([0.0, 0.0, -1.0, 1.0]))
        scores.append(max([grasp.score for grasp in plan(body, around=around, covariance=spread).grasps], default=0.0))
    assert scores[0] >= scores[1] > 0.9 > plan(body, around=Surroundings(), covariance=spread).grasps[0].score
    assert scores[2] < scores[1] - 0.3


def test_places_are_hidden_that_the_image_does_not_show_to_be_empty():
    depth = np.full((48, 64), 1.0)
    depth[:, :32] = np.nan
    around = Surroundings(depth=depth, camera=CAMERA)
    before, behind, dark, outside = [0.1, 0.0, 0.9], [0.1, 0.0, 1.1], [-0.1, 0.0, 0.9], [0.9, 0.0, 0.9]
    places = np.array([[before, before], [before, behind], [dark, outside]])
    np.testing.assert_allclose(around.hidden_share(places), [0, 0.5, 1])
    assert Surroundings().hidden_share(np.array([before])) == 1


def test_gaps_between_readings_hide_nothing_and_are_no_points():
    """Depth registered to three times as many pixels a side."""
    row, column = np.indices((48, 64))
    depth = np.where((row % 3 == 0) & (column % 3 == 0), 1.0, np.nan)
    around = Surroundings.of_image(depth, CAMERA, None)
    places = np.array([[x, y, z] for x in (-0.31, -0.1, 0.2) for y in (-0.2, 0.11) for z in (0.9, 1.1)])
    np.testing.assert_allclose(around.hidden_share(places.reshape(2, -1, 3)), 0.5)
    np.testing.assert_allclose(around.beyond(places), 1.0 - places[:, 2])
    assert len(around.points) == np.count_nonzero(np.isfinite(depth))


def test_a_doubtful_body_with_few_ways_is_planned_in_an_image_too():
    """All ways are looked at in the first round, so that none is left for the second."""
    around = Surroundings(depth=np.full((48, 64), 0.5), camera=CAMERA)
    body = Superquadric([0.038, 0.2, 0.2], [0.1, 0.1], [0.0, 0.0, 0.8], UPRIGHT)
    assert 0 < plan(body, around=around, covariance=sure(1, sigma=0.006)).grasps[0].score < 0.5


def test_a_plan_moves_with_the_scene():
    turn, shift = np.array([0.2, -0.4, 0.1, 0.88]), np.array([0.3, -0.1, 0.7])
    turn /= np.linalg.norm(turn)
    normal = quaternions.to_matrix(turn)[:, 2]
    bodies = [standing(*CAN), standing(*BOX, x=0.15)]
    here = plan(*bodies)
    around = Surroundings(plane=np.append(normal, -normal @ shift))
    there = plan(*(body.transformed(turn, shift) for body in bodies), around=around)
    for k in range(2):  # equal ones may come in another order
        assert there.of(k)[0].score == pytest.approx(here.of(k)[0].score, abs=2e-3)


def test_hostile_input_gets_an_answer_with_a_reason():
    rng = np.random.default_rng(3)
    size, shape = rng.uniform(0.01, 0.2, (200, 3)), rng.uniform(0.1, 1, (200, 2))
    places = rng.uniform([-1, -1, 0.05], [1, 1, 0.05], (200, 3))
    many = Superquadric(size, shape, places, rng.standard_normal((200, 4)))
    for around in (None, ON_TABLE):
        found = grasps(many, PANDA, np.full((200, 11, 11), np.nan), around)
        assert len(found.reasons) == 200
        assert all(bool(found.of(k)) == (found.reasons[k] == "") for k in range(200))
    tiny = Gripper("tiny", 0.002, 0.001, 0.001, 0.001, 0.01, (0.01, 0.01, 0.01), 5.0, "hand", PANDA.link_from_tcp)
    assert all("wider" in reason for reason in plan(standing(*CAN), standing(*BOX, x=0.2), hand=tiny).reasons)
    assert plan(covariance=np.zeros((0, 11, 11))).grasps == ()
    flat = plan(standing([0.1, 0.1, 0.002], [0.1, 0.1]))
    assert flat.grasps == ()
    assert flat.reasons[0]


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"covariance": np.zeros((2, 11, 11))}, "covariance"),
        ({"friction": 0.0}, "friction"),
        ({"friction": np.nan}, "friction"),
        ({"placement": -0.001}, "placement"),
    ],
)
def test_misuse_is_told(wrong, what):
    with pytest.raises(ValueError, match=what):
        plan(standing(*CAN), **wrong)
    with pytest.raises(ValueError, match="plane"):
        Surroundings(plane=np.ones(4))
    with pytest.raises(ValueError, match="camera: expected a pinhole camera"):
        Surroundings.of_image(np.ones((4, 4)), Camera(4, 4, 4.0, 4.0, 2.0, 2.0, "orthographic"), None)
    with pytest.raises(ValueError, match="gripper"):
        gripper("claw")


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"opening": 0.0}, "opening: expected a positive number, got 0.0"),
        ({"tip": np.nan}, "tip"),
        ({"palm": (0.03, 0.03)}, "palm: expected a positive number"),
        ({"hand": (0.06, 0.2)}, "hand: expected three positive numbers"),
        ({"hand": (0.06, 0.2, -0.1)}, "hand"),
        ({"opening": "0.08"}, "opening: expected a positive number, got '0.08'"),
        ({"link_from_tcp": ((0, 0, 0.1), (0, 0, 0, 0))}, "link_from_tcp: expected a position and a quaternion"),
        ({"link_from_tcp": (0, 0, 0.1)}, "link_from_tcp"),
    ],
)
def test_a_gripper_of_other_numbers_is_refused_before_it_plans(wrong, what):
    with pytest.raises(ValueError, match=what):
        replace(PANDA, **wrong)


def test_the_way_of_the_fingers_is_kept_clear_behind_a_narrow_hand():
    narrow = replace(PANDA, hand=(0.01, 0.05, 0.066))
    for hand in (narrow, PANDA):
        *fingers, behind = hand.boxes(hand.opening)
        for finger in fingers:
            assert (np.abs(finger[:2]) + finger[3:5] <= behind[3:5] + 1e-12).all()
    np.testing.assert_array_equal(narrow.boxes(0.0, reach=0.0)[2, 3:5], [0.005, 0.025])
    np.testing.assert_array_equal(PANDA.boxes(0.0)[2, 3:5], 0.5 * np.array(PANDA.hand[:2]))


@pytest.mark.parametrize("hand", GRIPPERS.values(), ids=lambda hand: hand.name)
def test_every_gripper_takes_a_can(hand):
    assert plan(standing(*CAN), hand=hand).grasps[0].score > 0.9
    assert np.linalg.norm(hand.link_from_tcp[1]) == pytest.approx(1.0)


def test_the_first_of_each_body_are_its_most_probable_ones():
    rng = np.random.default_rng(5)
    owner, logs = rng.integers(0, 4, 60), rng.integers(-9, 1, (60, 9)).astype(float)  # whole numbers: many are alike
    numbers = np.arange(60.0)
    trials = Trials(owner, np.zeros((60, 3, 4)), numbers, numbers, logs, np.zeros((60, 2)))
    total = logs.sum(axis=1)
    each = (sorted(np.flatnonzero((owner == k) & (total > -45)), key=lambda row: -total[row])[:5] for k in range(4))
    np.testing.assert_array_equal(trials.first(5, -45.0).opening, np.concatenate([*each]))
    assert not len(trials.at(np.empty(0, int)).first(5).owner)
