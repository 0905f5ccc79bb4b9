"""`dextouch bench retargeting`: hands of known joint angles, followed by ours and by others."""
