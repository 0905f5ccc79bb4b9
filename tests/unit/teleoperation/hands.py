"""Samples of a hand that moves, and a follower that they are given to, in virtual time."""

from functools import cache

import numpy as np

from benchmarks.simulated.hand_motions import robot_motion
from services.pipelines.teleoperation.hand_follower import HandFollower, HandSample
from services.pipelines.teleoperation.settings import CommandLimits

SIDE = "right"
RATE_HZ = 200.0
SAMPLE_HZ = 60.0


@cache
def motion(num_samples=600):
    """A motion of the robot's own hand at 60 Hz, without contact."""
    return robot_motion(SIDE, num_samples, 1, natural=True)


def sample(index):
    """A sample of the motion, which repeats, with small noise: none is like another."""
    found = motion()
    noise_m = np.random.default_rng(index).normal(0, 1e-4, (25, 3))
    keypoints_m = found.keypoints_m[index % len(found)] + noise_m
    return HandSample(keypoints_m, 10**15 + round(index * 1e9 / SAMPLE_HZ))


class Run:
    """Plays samples to a follower and collects its commands; both by the same virtual clock."""

    def __init__(self, rate_hz=RATE_HZ, calibration=None, **limits):
        self.follower = HandFollower(SIDE, CommandLimits(**limits), rate_hz, calibration or {})
        self.t_s = 1000.0
        self.index = 0
        self.commands = []

    def play(self, duration_s, sample_of=sample):
        """Commands of a time; `sample_of` gives the sample of a number, None where it is lost."""
        first = len(self.commands)
        for _ in range(round(duration_s / self.follower.period_s)):
            while self.index / SAMPLE_HZ <= self.t_s - 1000.0:
                given = sample_of(self.index)
                if given is not None:
                    self.follower.receive(given, self.t_s)
                if self.follower.can_check:
                    self.follower.check_person()
                self.index += 1
            self.commands.append(self.follower.command(self.t_s))
            self.t_s += self.follower.period_s
        return self.commands[first:]

    def joints_rad(self):
        """Angles of all commands so far."""
        return np.stack([command.joints_rad for command in self.commands])


def lost(_):
    """No sample at all."""
    return
