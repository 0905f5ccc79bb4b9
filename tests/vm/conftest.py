"""Tests in `guest` need the kernel that test_kernel_devices.py boots; nobody else collects them."""

import os

collect_ignore_glob = [] if os.environ.get("DEXTOUCH_VM_GUEST") else ["guest/*"]
