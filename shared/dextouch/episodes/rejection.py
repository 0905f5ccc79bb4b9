"""Rule of which reviewed episodes are left out of training."""

from dextouch.episodes.format import KINDS
from dextouch.episodes.store import EpisodeStore
from dextouch.schemas import EpisodeAttributes


def is_rejected(store: EpisodeStore, about: EpisodeAttributes) -> bool:
    """Whether an episode must not be trained on.

    An episode is rejected by its own review; one without a review is rejected with a recording or
    episode that it was made from, if that is in the same store.
    """
    own = store.review(about.episode_id)
    if own is not None:
        return own.verdict == "rejected"
    for source in about.lineage:
        for kind in KINDS:
            if source.kind == kind and store.exists(source.id, kind=kind):
                review = store.review(source.id, kind=kind)
                if review is not None and review.verdict == "rejected":
                    return True
    return False
