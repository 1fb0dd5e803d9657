"""How far a body at rest may be pushed before it leaves its basin (compiled)."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.compilation import compiled
from pipeline.kinematics.direct.height_map import depth_over
from pipeline.kinematics.direct.surfaces import FAR_MM, Attitude, Float

#: Steps to either side.
STEPS = 5
#: The depth may rise by this much within a basin: roughness (mm).
ROUGH_MM = 0.02
#: Only every so many samples are looked at.
THINNING = 4


@compiled
def margins(attitude: Attitude, pose: Float, step: Float, out: Float) -> None:
    """Write how far x, y and theta may each be pushed, the others held, while the depth keeps falling.

    The smaller of both senses counts. This is coarse: straight ways, few steps, a thinned height map.

    Parameters
    ----------
    attitude : Attitude
    pose : (4,) float64
        x, y, theta, z.
    step : (3,) float64
        Length of a step in x, y (mm) and theta (rad); at most ``STEPS`` are made.
    out : (3,) float64
    """
    samples, trial = attitude.samples[::THINNING].copy(), pose.copy()
    gaps = np.empty(samples.shape[0])
    rest = depth_over(attitude.heights, samples, pose, gaps)
    for axis in range(3):
        out[axis] = STEPS * step[axis]
        for sense in (-1.0, 1.0):
            lowest = rest
            for count in range(1, STEPS + 1):
                trial[:] = pose
                trial[axis] += sense * count * step[axis]
                depth = depth_over(attitude.heights, samples, trial, gaps)
                if depth > lowest + ROUGH_MM or depth > FAR_MM:
                    out[axis] = min(out[axis], (count - 1) * step[axis])
                    break
                lowest = min(lowest, depth)
