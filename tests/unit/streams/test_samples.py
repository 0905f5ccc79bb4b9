import numpy as np
import pytest

from dextouch.streams import Sample, SampleBatch, encoded_values

VALUES = {
    "counts": np.arange(360, dtype="<u2"),
    "image": np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3),
    "jpeg": encoded_values([b"bytes"]).reshape(()),
}


@pytest.mark.parametrize("kind", VALUES)
@pytest.mark.parametrize("num_samples", [1, 2])
def test_a_batch_holds_its_samples(kind, num_samples):
    samples = [Sample(10 + i, VALUES[kind], 20 + i, 30 + i) for i in range(num_samples)]
    batch = SampleBatch.from_samples(samples)
    assert batch.values.shape == (num_samples, *VALUES[kind].shape)
    assert batch.values.dtype == VALUES[kind].dtype
    assert {a.dtype for a in (batch.t_host_ns, batch.t_device_ns, batch.sequence)} == {
        np.dtype(np.int64)
    }
    assert batch.t_host_ns.tolist() == [s.t_host_ns for s in samples]
    assert batch.t_device_ns.tolist() == [s.t_device_ns for s in samples]
    assert batch.sequence.tolist() == [s.sequence for s in samples]
    assert all(np.array_equal(row, VALUES[kind]) for row in batch.values)


def test_one_sample_is_not_copied():
    image = VALUES["image"]
    batch = SampleBatch.from_samples([Sample(1, image)])
    assert np.shares_memory(batch.values, image)
