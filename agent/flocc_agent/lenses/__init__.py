"""Camera models as calibration tools know them, and the pinhole camera that their pictures are remapped to.

Pure numpy: recordings, bags and live ROS 2 robots share it. Pixel (0, 0) is the centre of the first one, as in OpenCV.
"""

from flocc_agent.lenses.models import CameraModel, LensKind
from flocc_agent.lenses.straight import WIDE_VIEW_MAX_RAD, pixel_map, straight_camera

__all__ = ["WIDE_VIEW_MAX_RAD", "CameraModel", "LensKind", "pixel_map", "straight_camera"]
