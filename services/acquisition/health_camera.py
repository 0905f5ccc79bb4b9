"""Health check of a camera's images: frozen, blurred, clipped or missing."""

from typing import Literal, Protocol, runtime_checkable

from services.acquisition.drivers.base import Driver
from services.acquisition.health_blocks import Block
from services.acquisition.health_levels import Verdict
from services.acquisition.schemas import Code, HealthFinding

CLIPPED_LIMIT = 0.2
ERROR_AFTER_NS = 1_000_000_000


@runtime_checkable
class ImageQualityLike(Protocol):
    """The part of a driver's image quality that is checked."""

    @property
    def frozen(self) -> bool:
        """More than 3 identical images in a row."""
        ...

    @property
    def blurred(self) -> bool:
        """Much less sharp than usual in this session."""
        ...

    @property
    def clipped_ratio(self) -> float:
        """Share of pixels that are black or white to the limit, 0 … 1."""
        ...

    @property
    def gap(self) -> bool:
        """An image is missing in the camera's own timestamps within the last second."""
        ...

    @property
    def num_dropped(self) -> int:
        """Images that found the encoder's queue full."""
        ...


@runtime_checkable
class ChecksImages(Protocol):
    """A driver that computes the quality of its images."""

    @property
    def quality(self) -> ImageQualityLike:
        """Quality of the newest checked image."""
        ...


class CameraJudge:
    """Judges one camera: anything is a warning, and an error after a second."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._since_ns: dict[Code, int] = {}

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del block
        driver = self._driver
        if not isinstance(driver, ChecksImages):
            return Verdict()
        quality = driver.quality
        clipped = quality.clipped_ratio
        too_much = f"{clipped:.0%} of the image black or white"
        flags: dict[Code, tuple[bool, str]] = {
            "image_frozen": (quality.frozen, "the same image repeatedly"),
            "image_blurred": (quality.blurred, "much less sharp than usual"),
            "image_gap": (quality.gap, "images are missing according to its timestamps"),
            "image_clipped": (clipped > CLIPPED_LIMIT, too_much),
        }
        findings = []
        for code, (is_raised, text) in flags.items():
            if not is_raised:
                self._since_ns.pop(code, None)
                continue
            lasted_ns = now_ns - self._since_ns.setdefault(code, now_ns)
            level: Literal["WARN", "ERROR"] = "ERROR" if lasted_ns >= ERROR_AFTER_NS else "WARN"
            findings.append(HealthFinding(code=code, level=level, message=text))
        figures = {
            "image_clipped_ratio": clipped,
            "image_frozen": float(quality.frozen),
            "image_blurred": float(quality.blurred),
        }
        return Verdict(tuple(findings), figures)
