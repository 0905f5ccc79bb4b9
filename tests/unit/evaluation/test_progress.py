"""Long jobs say how far they are where no terminal shows a bar."""

from services.evaluation.progress import Progress


def test_a_line_at_every_tenth_goes_to_a_pipe(capsys):
    with Progress("rollouts", 25) as progress:
        for number in range(25):
            progress.advance(loss=number / 8)
    out, err = capsys.readouterr()
    lines = [line.split() for line in err.splitlines() if line.strip()]
    assert out == ""
    assert [int(line[1]) for line in lines] == [3, 5, 8, 10, 13, 15, 18, 20, 23, 25]
    assert lines[-1] == ["rollouts", "25", "of", "25", "loss", "3"]
