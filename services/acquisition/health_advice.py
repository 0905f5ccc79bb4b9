"""What an operator does about each code of the health: one line a code."""

from collections.abc import Mapping
from typing import Final

from services.acquisition.schemas import Code

ADVICE: Final[Mapping[Code, str]] = {
    "unplugged": "Check plug, cable and power; it is opened again by itself.",
    "silent": "Switch the device off and on; if it stays silent, try another cable or port.",
    "late": "Wait a second; if it comes again, look at the load of this computer.",
    "rate": "Set the rate that the station expects, and charge the device.",
    "loss": "Move the receiver closer, or use another port without a hub.",
    "damage": "Change the cable and lead it away from motors and chargers.",
    "refused": "Restart the device; if it goes on, its firmware sends what is no reading.",
    "suspect": "Check cable and rate of the port; packets that cannot be readings are held back.",
    "queue": "Close other programs, or ask the camera for smaller or fewer images.",
    "repeated": "Nothing is lost; if it lasts, use another port without a hub.",
    "reordered": "Use a direct link: what comes behind later packets is left out.",
    "restart": "The device started anew; check its power and its battery.",
    "reconnect": "Fix plug and cable so that they cannot move; record the take again.",
    "wrong_side": "Swap the left and the right device, or their names in the settings.",
    "wrong_version": "Update the device's firmware, or this station.",
    "rejected": "Another kind of device answers here; check port and protocol in the settings.",
    "jitter": "Close other programs and use a port without a hub.",
    "latency": "Close other programs; this computer is too slow for what arrives.",
    "gap": "Record the take again if this happened during it; then check cable and hub.",
    "clock_skew": "Let the device warm up; if it stays, its clock is out of order.",
    "clock_residual": "Use a direct link: the delay of its packets varies too much.",
    "clock_step": "Record the take again; leave the device on between takes.",
    "clock_stamps": "Restart the device: its packets come without their time.",
    "latency_calibration": "Calibrate the path delay again; cable, hub or firmware changed.",
    "taxels_dead": "Look for a broken line or connector; exchange the glove if it stays.",
    "taxels_stuck": "Take off what presses there and bend the glove; exchange it if it stays.",
    "taxels_saturated": "Let go of what presses there; if it stays, the cells are shorted.",
    "baseline": "Open the hand, touch nothing, and tare the glove again.",
    "nan": "Look for a broken line or connector; restart the glove.",
    "tracking": "Bring it back into view, clear the line of sight, and charge it.",
    "jump": "Cover mirrors and other light sources, and fix the base stations.",
    "pose_jitter": "Fix tracker and base stations so that nothing shakes.",
    "image_frozen": "Plug the camera in again; it sends the same image.",
    "image_blurred": "Clean the lens and set its focus.",
    "image_clipped": "Set exposure or light; nothing may cover the lens.",
    "image_gap": "Give the camera a port of its own; it leaves out images.",
    "disk": "Upload and delete takes, or spool to a larger disk.",
    "calibration_missing": "Calibrate with `dextouch station calibrate` before recording.",
    "calibration_age": "Calibrate again with `dextouch station calibrate`.",
    "upload_refused": "Put right what the store names, then send the take again from the page.",
}
