"""Surfaces are no objects: tables that sensors bend, tables without a border, room corners, what stands beyond."""

import cv2
import numpy as np
import pytest
from table_scenes import VGA, Table, best_iou, ious, judged_by_network, noisy

from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import support_plane
from sq_perception.segmentation.options import SegmentationOptions, largest_edge
from sq_perception.segmentation.segments import from_labels, propose, segment
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
STRAIGHT = np.array([0.0, 0.0, 0.0, 1.0])
TOLERANCE = support_plane.TOLERANCE


def plane_image(normal, distance, camera=CAMERA):
    """Depth of the plane n.p + distance = 0, infinite where it is not seen."""
    return plane_depth(np.append(normal, distance), camera)


def slanted(degrees):
    """The normal of a table that the camera looks at from so many degrees above its horizon."""
    angle = np.deg2rad(degrees)
    return np.array([0.0, -np.cos(angle), -np.sin(angle)])


def with_bodies(depth, bodies, camera=CAMERA):
    rendered, index = raycast.render(Superquadric.stack(bodies), camera)
    seen = (index >= 0) & (rendered < depth)
    return np.where(seen, rendered, depth), np.where(seen, index + 1, 0)


def bulging(away, bulge, camera=CAMERA):
    """A wall-like table seen from straight above, nearer in the middle by ``bulge``: a paraboloid about the middle."""
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(u - camera.cx, v - camera.cy) / np.hypot(camera.cx, camera.cy)
    return away - bulge * (1 - radius**2)


def cube_on(depth, u, v, half, camera=CAMERA):
    """A box with its base at the depth of that pixel, upright before a camera that looks straight down."""
    base = camera.unproject(np.array(u), np.array(v), np.array(depth[v, u]))
    return Superquadric(np.full(3, half), np.full(2, 0.1), base - [0, 0, half], STRAIGHT)


@pytest.mark.parametrize("away", [0.3, 0.45, 0.6])
def test_a_bulging_table_is_no_object(away):
    """A centimetre, as structured light shows it close by."""
    assert segment(noisy(bulging(away, 0.01)), CAMERA).ids == ()


@pytest.mark.parametrize("away", [0.45, 0.6])
def test_a_box_on_a_bulging_table_is_found_with_its_outline(away):
    table = bulging(away, 0.01)
    depth, truth = with_bodies(table, [cube_on(table, 110, 120, 0.03)])
    found = segment(noisy(depth), CAMERA)
    assert len(found.ids) == 1
    assert best_iou(truth == 1, found.labels) > 0.9


def test_the_noise_of_a_table_is_measured():
    assert plane_of(noisy(np.full((240, 320), 0.6), 5e-4)).sigma == pytest.approx(5e-4, rel=0.25)


def plane_of(depth):
    return support_plane.support(depth, np.isfinite(depth), CAMERA)


@pytest.mark.parametrize("seed", range(3))
def test_a_board_that_leans_on_a_box_is_found(seed):
    """It rises by 15 degrees over 8 cm, on one side of the box alone."""
    table = plane_image(slanted(90), 0.8)
    v, u = np.indices(table.shape)
    x = (u - CAMERA.cx) / CAMERA.fx * 0.8
    board = (np.abs(v - 120) < 20) & (x > 0.02) & (x < 0.1)
    rise = np.where(board, np.tan(np.deg2rad(15)) * (x - 0.02), 0)
    depth, truth = with_bodies(table - rise, [cube_on(table, 207, 120, 0.04)])
    found = segment(noisy(depth, 1e-3, seed), CAMERA)
    assert len(found.ids) == 2
    assert min(best_iou(mask, found.labels) for mask in (truth == 1, board & (truth == 0))) > 0.7


@pytest.mark.parametrize("seed", range(3))
def test_a_low_thing_whose_sides_the_sensor_smooths_is_found(seed):
    """A board 2 cm high, its sides smeared over 4 cm: slopes of about 27 degrees."""
    table = plane_image(slanted(90), 0.8)
    v, u = np.indices(table.shape)
    board = (np.abs(u - 150) < 35) & (np.abs(v - 120) < 25)
    depth = cv2.blur((table - 0.02 * board).astype(np.float32), (13, 13))
    found = segment(noisy(depth, 1e-3, seed), CAMERA)
    assert len(found.ids) == 1
    assert best_iou(board, found.labels) > 0.7


@pytest.mark.parametrize("seed", range(3))
def test_a_low_thing_near_the_camera_is_found_though_the_noise_grows_along_it(seed):
    """A book 14 mm high, 0.6 to 0.8 m away, its sides smeared over some pixels, with a box on it."""
    table = Table(pitch=0.65, distance=0.7)
    book, box = table.body(0, 0.02, [0.1, 0.14, 0.007]), table.body(0.06, 0.02, [0.02, 0.1, 0.05], height=0.014)
    depth, truth = table.see([book, box])
    smeared = cv2.blur(table.see([book])[0], (9, 9))
    found = segment(noisy(np.where(truth == 2, depth, smeared), 1.5e-3, seed), VGA)
    assert min(ious(truth, found.labels)) > 0.8


@pytest.mark.parametrize("seed", range(3))
def test_bumps_where_the_noise_is_large_are_no_things(seed):
    """A third of a table has ten times the noise of the rest, whose noise alone would make things of its bumps."""
    table = plane_image(slanted(90), 0.8)
    v, u = np.indices(table.shape)
    thing = np.hypot(u - 80, v - 120) < 15
    waves = cv2.blur(np.random.default_rng(seed).standard_normal(table.shape), (9, 9), borderType=cv2.BORDER_REFLECT)
    depth = noisy(table - 0.025 * thing, 1e-3, seed) + np.where(u > 210, 0.01 * waves / waves.std(), 0)
    found = judged_by_network(depth.astype(np.float32), CAMERA)
    assert best_iou(thing, found.labels) > 0.8
    assert 3 * len(found.ids) < len(propose(depth.astype(np.float32), CAMERA).ids)


@pytest.mark.parametrize("seed", range(3))
def test_the_height_of_a_board_is_no_noise_to_what_stands_on_it(seed):
    """The board is 6 mm high, too low for a thing, and all around what stands on it."""
    table = plane_image(slanted(90), 0.8)
    v, u = np.indices(table.shape)
    board = (np.abs(u - 160) < 80) & (np.abs(v - 120) < 60)
    things = [np.hypot(u - x, v - 120) < 15 for x in (125, 195)]
    found = segment(noisy(table - 0.006 * board - 0.03 * (things[0] | things[1]), 1e-3, seed), CAMERA)
    assert min(best_iou(thing, found.labels) for thing in things) > 0.8


@pytest.mark.parametrize("away", [0.05, -0.02])
def test_a_carton_that_the_border_cuts_is_no_furniture(away):
    """Its front fills a quarter of the image, more than a plane needs, and is most of that plane."""
    normal = slanted(45)
    foot = np.array([0.0, 0.0, 0.35 / np.sin(np.deg2rad(45))]) + away * np.cross([1.0, 0.0, 0.0], normal)
    carton = Superquadric(np.array([0.1, 0.04, 0.15]), np.full(2, 0.1), foot + 0.15 * normal, frame_of(normal))
    depth, truth = with_bodies(plane_image(normal, 0.35), [carton])
    assert truth[0].any()
    assert (truth > 0).mean() > 0.2
    assert best_iou(truth == 1, segment(noisy(depth), CAMERA).labels) > 0.9


def test_a_table_whose_border_is_round_carries_what_stands_on_it():
    """Its front edge bends down and runs on as an apron, a floor lies below: it is the support all the same."""
    normal = slanted(35)
    table = plane_image(normal, 0.45)
    v, _ = np.indices(table.shape)
    depth = np.where(v > 185, table[185, 0], table)
    middle = CAMERA.unproject(np.array(150), np.array(130), np.array(table[130, 150]))
    body = Superquadric(np.array([0.05, 0.04, 0.05]), np.full(2, 0.2), middle + 0.05 * normal, frame_of(normal))
    depth, truth = with_bodies(depth, [body])
    found = segment(noisy(depth), CAMERA)
    assert found.plane is not None
    assert np.degrees(np.arccos(np.clip(found.plane[:3] @ normal, -1, 1))) < 2
    assert best_iou(truth == 1, found.labels) > 0.85


def test_a_table_larger_than_a_thing_is_the_support_however_much_floor_is_seen():
    """A bench 90 cm long; a box as high that is as much of the image stands on the floor with what it carries."""
    floor, high = Table(pitch=0.8, distance=1.6), 0.45
    things = [floor.body(-0.1, -0.05, (0.04, 0.03, 0.05), height=high)]
    things.append(floor.body(0.1, 0.06, (0.05, 0.04, 0.03), (0.1, 1.0), height=high))
    for half, stands in (((0.45, 0.2, 0.015), high), ((0.28, 0.28, high / 2), 0.0)):
        top = floor.body(0, 0, half, (0.05, 0.05), turn=0.4, height=high - 2 * half[2])
        depth, truth = floor.see([top, *things], 1e-3)
        assert 0.09 < np.mean(truth == 1) < 0.3
        found = segment(depth, VGA)
        assert min(best_iou(truth == k, found.labels) for k in (2, 3)) > 0.85
        assert found.plane == pytest.approx(floor.plane - np.array([0, 0, 0, stands]), abs=0.01)


def test_the_bottom_of_a_bin_is_its_support_and_not_its_wall():
    """From above the wall that is nearest to the user is below the middle of the image, as a table would be."""
    bottom, wall = np.full((240, 320), 0.8), plane_image(np.array([0.0, -1.0, 0.0]), 0.2)
    v, u = np.indices(bottom.shape)
    depth = np.minimum(bottom, wall)
    things = (u // 40 % 2 == 0) & (v // 40 % 2 == 0) & (depth > 0.79)
    high = 0.03 + 0.02 * ((3 * (u // 80) + 2 * (v // 80)) % 5)
    found = segment(noisy(depth - high * things, 1e-3), CAMERA)
    assert found.plane == pytest.approx([0, 0, -1, 0.8], abs=0.01)
    assert best_iou(things & (u // 80 == 1) & (v // 80 == 1), found.labels) > 0.9


def room_corner():
    """A floor and two walls at right angles, 1.5 m away, the camera 1 m above the floor and tilted down."""
    tilt = np.deg2rad(25)
    down = np.array([0.0, np.cos(tilt), np.sin(tilt)])
    ahead = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    left = (ahead + np.array([1.0, 0, 0])) / np.sqrt(2)
    right = (ahead - np.array([1.0, 0, 0])) / np.sqrt(2)
    return np.min([plane_image(-down, 1.0), plane_image(-left, 1.6), plane_image(-right, 1.6)], axis=0)


def test_a_room_corner_holds_no_objects_and_an_empty_table_from_straight_above_is_the_support():
    """As a wall it faces the camera, and nothing is close above it; but nothing is anywhere else."""
    assert judged_by_network(noisy(room_corner(), 2e-3), CAMERA).ids == ()
    found = segment(noisy(np.full((240, 320), 0.9), 2e-3), CAMERA)
    assert found.plane == pytest.approx([0, 0, -1, 0.9], abs=3e-3)
    assert found.ids == ()


def test_what_stands_behind_the_table_is_not_on_it():
    """A board half a metre behind the table's far edge, seen above it and running on below its height."""
    normal = slanted(30)
    table = plane_image(normal, 0.5)
    depth = np.where(table < 1.2, table, np.inf)
    up = normal
    ahead = np.array([0.0, -normal[2], normal[1]])
    ahead *= np.sign(ahead[2])
    behind = 1.6 * ahead - 0.5 * up
    body = Superquadric(np.array([0.12, 0.02, 0.25]), np.full(2, 0.1), behind, frame_of(normal))
    near = -0.5 * up + 0.85 * ahead + 0.05 * up
    thing = Superquadric(np.array([0.05, 0.05, 0.05]), np.full(2, 0.1), near, frame_of(normal))
    depth, truth = with_bodies(depth, [body, thing])
    assert np.count_nonzero(truth == 1) > 200
    found = judged_by_network(noisy(depth), CAMERA)
    assert len(found.ids) == 1
    assert best_iou(truth == 2, found.labels) > 0.85


def test_what_reaches_the_nearest_depth_may_hide_its_own_feet():
    """A box of which a sensor measures the far end alone: the rest of it, and the table below, are too near."""
    normal = slanted(50)
    table = plane_image(normal, 0.7)
    base = CAMERA.unproject(np.array(160), np.array(150), np.array(table[150, 160]))
    box = Superquadric(np.array([0.06, 0.06, 0.05]), np.full(2, 0.2), base + 0.05 * normal, frame_of(normal))
    depth, truth = with_bodies(table, [box])
    depth = noisy(depth)
    depth[depth < 0.78] = np.nan
    seen = (truth == 1) & np.isfinite(depth)
    assert 200 < np.count_nonzero(seen) < 0.2 * np.count_nonzero(truth == 1)
    found = segment(depth, CAMERA)
    assert len(found.ids) == 1
    assert best_iou(seen, found.labels) > 0.9


def frame_of(normal):
    return rotation.from_matrix(np.stack([[1, 0, 0], np.cross(normal, [1, 0, 0]), normal], axis=1))


def two_boxes():
    table = np.full((240, 320), 1.0)
    small = cube_on(table, 90, 120, 0.04)
    tall = Superquadric(np.array([0.2, 0.06, 0.05]), np.full(2, 0.1), np.array([0.2, 0.0, 0.95]), STRAIGHT)
    return with_bodies(table, [small, tall])


def test_an_object_is_no_larger_than_max_size():
    depth, truth = two_boxes()
    depth = noisy(depth)
    assert len(segment(depth, CAMERA).ids) == 2
    found = segment(depth, CAMERA, SegmentationOptions(max_size=0.3))
    assert len(found.ids) == 1
    assert best_iou(truth == 1, found.labels) > 0.9


@pytest.mark.parametrize(
    ("box", "pose"),
    [
        ((0.0, -1.0, 0.0, 1.0, 1.0, 2.0), None),
        ((-1.0, -1.0, 5.0, 0.0, 1.0, 7.0), ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 5.0))),
    ],
    ids=["of the camera", "of a frame that is turned about z and lies behind"],
)
def test_a_workspace_holds_the_middle_of_what_is_seen(box, pose):
    depth, truth = two_boxes()
    depth = noisy(depth)
    right = SegmentationOptions(workspace=box, workspace_pose=pose)
    found = segment(depth, CAMERA, right)
    assert len(found.ids) == 1
    assert best_iou(truth == 2, found.labels) > 0.9
    assert from_labels(truth.astype(np.int32), depth, CAMERA, right).ids == (2,)


def test_a_workspace_is_one_to_orthographic_cameras_too():
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, "orthographic")
    depth = np.full((48, 64), np.nan, np.float32)
    depth[10:20, 5:25], depth[10:20, 40:60] = 0.5, 0.6
    found = segment(depth, camera, SegmentationOptions(workspace=(0.0, -1.0, 0.0, 1.0, 1.0, 1.0)))
    assert found.ids == (1,)
    assert np.array_equal(found.labels > 0, depth == np.float32(0.6))


def test_no_more_masks_are_asked_for_their_place_than_are_wanted(monkeypatch):
    """A depth image that was taken for masks has thousands, whose frame took seconds; random numbers took minutes."""
    asked = []
    monkeypatch.setattr(SegmentationOptions, "is_within", lambda self, points: asked.append(len(points)) or True)
    labels = 1 + np.arange(48 * 64).reshape(48, 64) // 3
    options = SegmentationOptions(workspace=(-1.0, -1.0, 0.0, 1.0, 1.0, 2.0), max_objects=4)
    found = from_labels(labels, np.ones((48, 64)), Camera(64, 48, 60.0, 60.0, 31.5, 23.5), options)
    assert (found.ids, found.is_cut, asked) == ((1, 2, 3, 4), True, [3] * 5)


@pytest.mark.parametrize("box", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 0, 1), (0, 0, 0, 1, 1, np.nan)])
def test_a_workspace_has_an_inside(box):
    with pytest.raises(ValueError, match="workspace: expected least x, y, z"):
        SegmentationOptions(workspace=box)


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.7])
def test_the_largest_edge_is_that_of_the_box_and_not_its_diagonal(turn):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (20_000, 3)) * [0.4, 0.3, 0.1]
    c, s = np.cos(turn), np.sin(turn)
    points = points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    up = np.array([0.0, 0.0, 1.0])
    assert largest_edge(points, up) == pytest.approx(0.4, rel=0.08)
    assert largest_edge(np.concatenate([points, [[5.0, 5.0, 5.0]]]), up) == pytest.approx(0.4, rel=0.08)


def test_a_narrower_frame_shows_the_same_table(shared_data):
    """A shelf of which the table is an eighth: which triples are drawn hangs on every pixel at the border."""
    with np.load(shared_data / "frames" / "felix_9.npz") as content:
        depth, matrix = content["depth"].astype(np.float32), content["K"]
    height, width = depth.shape
    camera = Camera.from_matrix(matrix, width, height)
    up = np.array([-0.09, -0.99, 0.13]) / np.linalg.norm([-0.09, -0.99, 0.13])
    for top, left in np.ndindex(4, 4):
        window = depth[top : height - top, left : width - left].copy()
        plane = segment(window, camera.cropped(left, top, width - 2 * left, height - 2 * top)).plane
        assert plane is not None
        assert plane[:3] @ up > np.cos(np.deg2rad(3))


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("height", [0.02, 0.04, 0.08])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_equal_boxes_from_above_are_found(count, height, noise):
    """Their tops are one plane, of which each holds a part; but it is no wall."""
    table = Table(pitch=1.5, distance=0.6)
    grid = np.stack(np.meshgrid(*2 * [(np.arange(count) + 0.5) / count - 0.5]), axis=-1).reshape(-1, 2) * (0.48, 0.41)
    size = (0.19 / count, 0.16 / count, height / 2)
    depth, truth = table.see([table.body(x, y, size) for x, y in grid], noise=noise)
    assert min(ious(truth, segment(depth, VGA).labels)) > 0.8


@pytest.mark.parametrize("pitch", [0.15, 0.3])
@pytest.mark.parametrize("count", [3, 6])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_a_row_of_equal_boxes_from_a_low_camera_is_found(pitch, count, noise):
    """Their fronts are one plane."""
    table = Table(pitch, distance=0.8)
    places = 0.7 * ((np.arange(count) + 0.5) / count - 0.5)
    depth, truth = table.see([table.body(x, 0, (0.28 / count, 0.03, 0.1)) for x in places], noise=noise)
    assert min(ious(truth, segment(depth, VGA).labels)) > 0.8


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_things_among_others_of_their_height_are_found(seed):
    """Sixteen boxes 3 to 5 cm high: of their tops, a quarter of the image, some lie in one plane by chance."""
    rng = np.random.default_rng(seed)
    table = Table(pitch=1.2, distance=0.6)
    grid = np.stack(np.meshgrid(np.arange(4) - 1.5, np.arange(4) - 1.5), axis=-1).reshape(-1, 2) * (0.12, 0.102)
    boxes = [table.body(x, y, (0.048, 0.041, rng.uniform(0.014, 0.026))) for x, y in grid]
    depth, truth = table.see(boxes, noise=1e-3)
    assert min(ious(truth, segment(depth, VGA).labels)) > 0.9
