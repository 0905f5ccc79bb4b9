"""Care of a store: inspection for damage, repair with salvage of intact samples, and deletion."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.episodes.care.deletion import DeletionRequest as DeletionRequest
    from dextouch.episodes.care.deletion import delete_for_good as delete_for_good
    from dextouch.episodes.care.deletion import plan_deletion as plan_deletion
    from dextouch.episodes.care.deletion import reviews_by as reviews_by
    from dextouch.episodes.care.deletion_records import Covered as Covered
    from dextouch.episodes.care.deletion_records import DeletionRecords as DeletionRecords
    from dextouch.episodes.care.deletion_records import Outstanding as Outstanding
    from dextouch.episodes.care.deletion_records import TakeFacts as TakeFacts
    from dextouch.episodes.care.deletion_records import take_start as take_start
    from dextouch.episodes.care.inspection import UPLOADS as UPLOADS
    from dextouch.episodes.care.inspection import Finding as Finding
    from dextouch.episodes.care.inspection import ItemReport as ItemReport
    from dextouch.episodes.care.inspection import Progress as Progress
    from dextouch.episodes.care.inspection import inspect_group as inspect_group
    from dextouch.episodes.care.inspection import inspect_stage as inspect_stage
    from dextouch.episodes.care.inspection import inspect_upload as inspect_upload
    from dextouch.episodes.care.inspection import is_held as is_held
    from dextouch.episodes.care.inspection import open_contents as open_contents
    from dextouch.episodes.care.inspection import unfinished_folders as unfinished_folders
    from dextouch.episodes.care.repair import LEFT as LEFT
    from dextouch.episodes.care.repair import RepairReport as RepairReport
    from dextouch.episodes.care.repair import repair_group as repair_group
    from dextouch.episodes.care.repair import repair_uploads as repair_uploads
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
