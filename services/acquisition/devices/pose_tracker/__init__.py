"""Pose trackers on a wrist or the head, by HID, USB or the bridge to their SDK."""
