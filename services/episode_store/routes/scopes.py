"""The scopes that keys need: reading, and writing."""

from fastapi import Depends

from dextouch.serving.access import RequireScope

MAY_READ = Depends(RequireScope("store_read"))
MAY_WRITE = Depends(RequireScope("store_write"))
