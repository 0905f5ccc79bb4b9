"""Access scopes of the store: read and write."""

from fastapi import Depends

from dextouch.serving import RequireScope

MAY_READ = Depends(RequireScope("store_read"))
MAY_WRITE = Depends(RequireScope("store_write"))
