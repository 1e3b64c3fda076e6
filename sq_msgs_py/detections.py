"""vision_msgs/Detection3DArray of superquadrics; needs vision_msgs 4 (Humble and later).

| field | what it holds |
| --- | --- |
| header | that of the bodies; the same in each detection |
| id | ``<prefix><id>``, with tracking the same from frame to frame |
| results[0].hypothesis.class_id | ``superquadric``: a shape was recovered, nothing was classified |
| results[0].hypothesis.score | score, 0 to 1; 0 where it is unknown |
| results[0].pose.pose, bbox.center | pose of the body: its centre and its axes |
| results[0].pose.covariance | of that pose, row by row; all 0 where unknown |
| bbox.size | FULL sizes 2 a1, 2 a2, 2 a3: the box with the body's axes that encloses it and touches it in six faces |

The exponents e1 e2, the deviations of the sizes, residual and status have no place here.  They are in the PointCloud2
of the same stamp (:mod:`sq_msgs_py.superquadrics`), whose ``id`` is the number at the end of the detection's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py.poses import pose_messages
from sq_msgs_py.superquadrics import FAILED, SuperquadricArray
from sq_msgs_py.transforms import PREFIX, name

if TYPE_CHECKING:
    from vision_msgs.msg import Detection3DArray

_CLASS_ID = "superquadric"


def detections(
    superquadrics: SuperquadricArray,
    header: Any,
    *,
    covariances: np.ndarray | None = None,
    prefix: str = PREFIX,
) -> Detection3DArray:
    """One detection for each body that did not fail.

    Parameters
    ----------
    header
        std_msgs/Header of the bodies.
    covariances : (n, 6, 6), optional
        Of the poses of all n bodies, failed ones included, as in :mod:`sq_msgs_py.poses`.
    prefix
        Of the names of the bodies.

    Raises
    ------
    ImportError
        Without vision_msgs.
    ValueError
        If the covariances have another shape or a quaternion names no rotation.
    """
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

    count = len(superquadrics)
    known = np.full((count, 6, 6), np.nan) if covariances is None else np.asarray(covariances, dtype=float)
    if known.shape != (count, 6, 6):
        raise ValueError(f"covariances: expected shape ({count}, 6, 6), got {known.shape}")
    known = known[superquadrics.status != FAILED]
    bodies = superquadrics.recovered
    message = Detection3DArray(header=header)
    for k, pose in enumerate(pose_messages(bodies)):
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id = _CLASS_ID
        result.hypothesis.score = float(np.nan_to_num(bodies.score[k], nan=0.0, posinf=0.0, neginf=0.0))
        result.pose.pose = pose
        if np.isfinite(known[k]).all():
            result.pose.covariance = known[k].ravel()
        detection = Detection3D(header=header, results=[result], id=name(bodies.id[k], prefix))
        detection.bbox.center = pose
        size = detection.bbox.size
        size.x, size.y, size.z = (2.0 * bodies.size[k].astype(float)).tolist()
        message.detections.append(detection)
    return message
