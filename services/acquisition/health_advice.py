"""Advice for operators: one line for each health code."""

from collections.abc import Mapping
from typing import Final

from services.acquisition.schemas import Code

ADVICE: Final[Mapping[Code, str]] = {
    "unplugged": "Check plug, cable and power; the station reconnects automatically.",
    "silent": "Power-cycle the device; if it stays silent, try another cable or port.",
    "late": "Wait a second; if it happens again, check the load of this computer.",
    "rate": "Set the device to the rate that the station expects, and charge it.",
    "loss": "Move the receiver closer, or use another port without a hub.",
    "damage": "Replace the cable and keep it away from motors and chargers.",
    "refused": "Restart the device; if it continues, its firmware sends invalid readings.",
    "suspect": "Check the cable and the port's baud rate; implausible packets are held back.",
    "queue": "Close other programs, or set the camera to smaller or fewer images.",
    "repeated": "No data is lost; if it continues, use another port without a hub.",
    "reordered": "Use a direct link; packets that arrive after newer ones are dropped.",
    "restart": "The device restarted; check its power supply and battery.",
    "reconnect": "Secure plug and cable, then record the take again.",
    "wrong_side": "Swap the left and the right device, or their entries in the settings.",
    "wrong_version": "Update the device's firmware, or this station.",
    "rejected": "Another kind of device responds; check port and protocol in the settings.",
    "jitter": "Close other programs and use a port without a hub.",
    "latency": "Close other programs; this computer is too slow for the incoming data.",
    "gap": "If it happened during a take, record it again; then check cable and hub.",
    "clock_skew": "Let the device warm up; if it continues, its clock is faulty.",
    "clock_residual": "Use a direct link; the latency of its packets varies too much.",
    "clock_step": "Record the take again; leave the device on between takes.",
    "clock_stamps": "Restart the device; its packets have no timestamps.",
    "latency_calibration": "Calibrate the path latency again; cable, hub or firmware has changed.",
    "taxels_dead": "Look for a broken wire or connector; replace the glove if it continues.",
    "taxels_stuck": "Remove what presses there and flex the glove; replace it if it continues.",
    "taxels_saturated": "Release what presses there; if it continues, the cells are shorted.",
    "baseline": "Open the hand, touch nothing, and tare the glove again.",
    "nan": "Look for a broken wire or connector; restart the glove.",
    "tracking": "Bring it back into view, clear the line of sight, and charge it.",
    "jump": "Cover mirrors and other light sources, and fix the base stations in place.",
    "pose_jitter": "Fix tracker and base stations in place so that nothing vibrates.",
    "image_frozen": "Reconnect the camera; it repeats the same image.",
    "image_blurred": "Clean the lens and adjust the focus.",
    "image_clipped": "Adjust exposure or lighting, and make sure that nothing covers the lens.",
    "image_gap": "Connect the camera to a port of its own; it skips images.",
    "disk": "Upload and delete takes, or use a larger disk for the spool.",
    "calibration_missing": "Calibrate with `dextouch station calibrate` before recording.",
    "calibration_age": "Calibrate again with `dextouch station calibrate`.",
    "upload_refused": "Resolve the reason that the store gives, then send the take again.",
}
