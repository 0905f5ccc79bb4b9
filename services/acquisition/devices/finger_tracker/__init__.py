"""Finger trackers of one hand, by HID, USB or the bridge to their SDK."""
