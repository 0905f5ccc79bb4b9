"""Care of a store: inspection for damage, repair with salvage of intact samples, and deletion."""

from dextouch.episodes.care.deletion import DeletionRequest, delete_for_good, plan_deletion
from dextouch.episodes.care.inspection import (
    UPLOADS,
    Finding,
    ItemReport,
    Progress,
    inspect_group,
    inspect_stage,
    inspect_upload,
    interrupted_takes,
    open_contents,
    unfinished_folders,
)
from dextouch.episodes.care.repair import LEFT, RepairReport, repair_group, repair_unfinished

__all__ = [
    "LEFT",
    "UPLOADS",
    "DeletionRequest",
    "Finding",
    "ItemReport",
    "Progress",
    "RepairReport",
    "delete_for_good",
    "inspect_group",
    "inspect_stage",
    "inspect_upload",
    "interrupted_takes",
    "open_contents",
    "plan_deletion",
    "repair_group",
    "repair_unfinished",
    "unfinished_folders",
]
