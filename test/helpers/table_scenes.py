"""Bodies on a table, seen by a camera with noise, and how well segments cover them."""

from functools import cache

import numpy as np

from sq_perception import Camera, Superquadric
from sq_perception.geometry import rotation
from sq_perception.imaging import raycast
from sq_perception.learning import inference
from sq_perception.recovery.own_segments import SegmentNetwork
from sq_perception.segmentation import segments
from sq_perception.segmentation.options import SegmentationOptions
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import plane_depth

VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
BOX = (0.1, 0.1)


class Table:
    """A table at a distance, seen at a pitch below the horizon and a roll; bodies are placed on it."""

    def __init__(self, pitch=0.75, roll=0.0, distance=0.9):
        up = -np.array([np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), np.sin(pitch)])
        self.plane = np.append(up, distance * np.sin(pitch))
        self.origin = np.array([0, 0, distance])
        across = np.cross([0, 0, 1.0], up)
        across /= np.linalg.norm(across)
        self.axes = np.stack([across, np.cross(up, across), up], axis=1)

    def body(self, x, y, size, shape=BOX, turn=0.0, height=0.0):
        about = rotation.from_rotation_vector(np.array([0, 0, turn]))
        centre = self.origin + self.axes @ np.array([x, y, height + size[2]])
        turned = rotation.multiply(rotation.from_matrix(self.axes), about)
        return Superquadric(np.array(size), np.array(shape), centre, turned)

    def see(self, bodies, noise=0.0, seed=0, camera=VGA, table=True):
        """Depth float32 with noise that grows as z^2, and labels int32."""
        depth, index = raycast.render(Superquadric.stack(bodies), camera)
        behind = plane_depth(self.plane, camera) if table else np.full(depth.shape, np.inf)
        seen = (index >= 0) & ~(behind < depth)
        return noisy(np.where(seen, depth, behind), noise, seed), np.where(seen, index + 1, 0).astype(np.int32)

    def sensed(self, bodies, sensor, seed):
        """Depth float32 by a sensor of :data:`sensor_noise.PRESETS`, and labels int32."""
        depth, truth = self.see(bodies)
        measured = sensor_noise.preset(sensor).measure(depth.astype(float), VGA, np.random.default_rng(seed))
        return measured.astype(np.float32), truth


def noisy(depth, noise=1e-3, seed=0):
    """Depth float32, NaN for inf, with noise that grows as z^2."""
    depth = np.where(np.isfinite(depth), depth, np.nan)
    rng = np.random.default_rng(seed)
    return (depth + noise * depth**2 * rng.standard_normal(depth.shape)).astype(np.float32)


def best_iou(mask, labels):
    """Of a body with the segment that fits it best."""
    found = [labels == k for k in range(1, labels.max() + 1)]
    return max((np.sum(mask & one) / np.sum(mask | one) for one in found), default=0.0)


def ious(truth, labels):
    return [best_iou(truth == k, labels) for k in range(1, truth.max() + 1)]


masks = cache(inference.load_masks)


def judged_by_network(depth, camera, **options):
    """The segments of an image as a recoverer has them: with the shipped network of masks."""
    found = segments.propose(depth, camera)
    network = SegmentNetwork(masks(), depth, camera, found.plane, lambda function, labels: function(labels))
    return segments.limit(network.improve(found), depth, camera, SegmentationOptions(**options))
