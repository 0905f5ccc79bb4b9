"""Command `dextouch demo`: the full path from device bytes to policy scores, against truth."""
