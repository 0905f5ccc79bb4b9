"""Blocks of samples as judges get them, made of numbers."""

import numpy as np

from services.acquisition.health.evaluation import Block, Evaluation

SECOND_NS = 10**9


def block(t_s, values=None, *, t_device_ns=None, sequence=None):
    t_ns = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    device_ns = t_ns + 77 if t_device_ns is None else np.asarray(t_device_ns, dtype=np.int64)
    numbers = np.arange(len(t_ns)) if sequence is None else np.asarray(sequence, dtype=np.int64)
    return Block(t_ns, device_ns, numbers.astype(np.int64), 0 * t_ns, values)


def judged(judge, samples, now_ns):
    evaluation = Evaluation(now_ns, samples)
    judge(evaluation)
    return evaluation


def codes(evaluation):
    return {finding.code: finding.level for finding in evaluation.findings}
