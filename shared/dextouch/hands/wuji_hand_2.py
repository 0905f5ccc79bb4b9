"""Kinematic tables of the Wuji Hand 2 (Beta 2), left and right, which are not exact mirrors.

Values are copied exactly from the manufacturer's MJCF (MIT, (c) 2025 Wuji Technology; `aiowuji`
0.1.0 on PyPI); fingertips are its sites `*_tip` (tests/accuracy/test_hand_model.py compares). Wrist
frame: fingers point along -z, the thumb side is +x, the right palm faces +y, the left -y. Each row:
the joint's frame in its parent (position in metres, quaternion w x y z), its axis, its limits in
radians.
"""

from typing import Final

from dextouch.hands.finger_table import FingerTable, JointRow

_NO_TURN: Final = (1.0, 0.0, 0.0, 0.0)
# Hinges S2, S3 and S4: their origins are knuckle, PIP and DIP (of the thumb: CMC, MCP and IP).
_POINTS: Final = (1, 2, 3)

LEFT_HAND: Final = (
    FingerTable(
        "thumb",
        (
            JointRow(
                "l_thumb_cmc_flex",
                (0.017208, -0.008138, -0.01646),
                (0.629482, 0.0606191, -0.720071, -0.285616),
                (-1.0, 0.0, 0.0),
                (-1.187, 1.291),
            ),
            JointRow(
                "l_thumb_cmc_abd",
                (0.00025789, 0.00063167, -0.014161),
                (0.934711, -0.0919289, 0.342519, 0.0233666),
                (0.0, 1.0, 0.0),
                (-1.484, 0.698),
            ),
            JointRow(
                "l_thumb_mcp",
                (-4.31365e-05, 2.49049e-05, -0.0334956),
                (0.965006, 0.0112895, 0.0421331, -0.258573),
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow("l_thumb_ip", (0.0, 0.0, -0.035), _NO_TURN, (-1.0, 0.0, 0.0), (-1.047, 1.57)),
        ),
        (0.0, 0.0, -0.029787),
        _POINTS,
    ),
    FingerTable(
        "index",
        (
            JointRow(
                "l_index_finger_mcp_flex",
                (0.0226524, 0.00332516, -0.069978),
                (0.996271, 0.0163849, -0.0693072, -0.0486945),
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "l_index_finger_mcp_abd",
                (0.0, 0.00120098, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "l_index_finger_pip",
                (0.0, 0.0, -0.0376),
                _NO_TURN,
                (-1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow(
                "l_index_finger_dip",
                (0.0, 0.0, -0.0295),
                _NO_TURN,
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "middle",
        (
            JointRow(
                "l_middle_finger_mcp_flex",
                (0.000943094, 0.00830301, -0.0739154),
                (0.999841, 0.0169537, 0.00558422, 0.000262989),
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "l_middle_finger_mcp_abd",
                (0.0, 0.00120098, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "l_middle_finger_pip",
                (0.0, 0.0, -0.0376),
                _NO_TURN,
                (-1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow(
                "l_middle_finger_dip",
                (0.0, 0.0, -0.0295),
                _NO_TURN,
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "ring",
        (
            JointRow(
                "l_ring_finger_mcp_flex",
                (-0.019752, 0.0055929, -0.065397),
                (0.996893, 0.00588709, 0.0710557, 0.0334773),
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "l_ring_finger_mcp_abd",
                (0.0, 0.00120098, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "l_ring_finger_pip",
                (0.0, 0.0, -0.0376),
                _NO_TURN,
                (-1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow(
                "l_ring_finger_dip", (0.0, 0.0, -0.0295), _NO_TURN, (-1.0, 0.0, 0.0), (-1.047, 1.57)
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "little",
        (
            JointRow(
                "l_pinky_mcp_flex",
                (-0.0373573, 0.00073376, -0.0552917),
                (0.989997, -0.00357904, 0.124209, 0.0668254),
                (-1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "l_pinky_mcp_abd",
                (0.0, 0.00120098, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "l_pinky_pip", (-0.0001, 0.0, -0.0336), _NO_TURN, (-1.0, 0.0, 0.0), (-1.047, 2.094)
            ),
            JointRow(
                "l_pinky_dip", (0.0, 0.0, -0.0275), _NO_TURN, (-1.0, 0.0, 0.0), (-1.047, 1.57)
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
)
RIGHT_HAND: Final = (
    FingerTable(
        "thumb",
        (
            JointRow(
                "r_thumb_cmc_flex",
                (0.01721, 0.008138, -0.016458),
                (0.62943, -0.0606446, -0.720105, 0.285638),
                (1.0, 0.0, 0.0),
                (-1.187, 1.291),
            ),
            JointRow(
                "r_thumb_cmc_abd",
                (0.00024788, -0.00053658, -0.014754),
                (0.934711, 0.0919289, 0.342519, -0.0233666),
                (0.0, 1.0, 0.0),
                (-1.484, 0.698),
            ),
            JointRow(
                "r_thumb_mcp",
                (0.0, 0.0, -0.0325),
                (0.959136, -0.0122059, 0.0418766, 0.279562),
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "r_thumb_ip", (-5e-05, 0.0, -0.035), _NO_TURN, (1.0, 0.0, 0.0), (-1.047, 1.57)
            ),
        ),
        (0.0, 0.0, -0.02978),
        _POINTS,
    ),
    FingerTable(
        "index",
        (
            JointRow(
                "r_index_finger_mcp_flex",
                (0.022661, -0.0033252, -0.069975),
                (0.996267, -0.0163875, -0.0693676, 0.0486957),
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "r_index_finger_mcp_abd",
                (0.0, -0.001201, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "r_index_finger_pip",
                (0.0, 0.0, -0.0376),
                _NO_TURN,
                (1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow(
                "r_index_finger_dip", (0.0, 0.0, -0.0295), _NO_TURN, (1.0, 0.0, 0.0), (-1.047, 1.57)
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "middle",
        (
            JointRow(
                "r_middle_finger_mcp_flex",
                (0.00095202, -0.008303, -0.073915),
                (0.999841, -0.016952, 0.00552374, -0.000264052),
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "r_middle_finger_mcp_abd",
                (0.0, -0.001201, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "r_middle_finger_pip",
                (0.0, 0.0, -0.0376),
                _NO_TURN,
                (1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow(
                "r_middle_finger_dip",
                (0.0, 0.0, -0.0295),
                _NO_TURN,
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "ring",
        (
            JointRow(
                "r_ring_finger_mcp_flex",
                (-0.019744, -0.0055929, -0.0654),
                (0.996897, -0.00588522, 0.0709958, -0.0334777),
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "r_ring_finger_mcp_abd",
                (0.0, -0.001201, -0.0145),
                _NO_TURN,
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "r_ring_finger_pip", (0.0, 0.0, -0.0376), _NO_TURN, (1.0, 0.0, 0.0), (-1.047, 2.094)
            ),
            JointRow(
                "r_ring_finger_dip", (0.0, 0.0, -0.0295), _NO_TURN, (1.0, 0.0, 0.0), (-1.047, 1.57)
            ),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
    FingerTable(
        "little",
        (
            JointRow(
                "r_pinky_mcp_flex",
                (-0.037351, -0.00073376, -0.055296),
                (0.98999, -0.00638516, 0.124818, -0.0655712),
                (1.0, 0.0, 0.0),
                (-1.047, 1.57),
            ),
            JointRow(
                "r_pinky_mcp_abd",
                (0.0, -0.001201, -0.0145),
                (1.0, 0.0, 0.0, 1.81365e-05),
                (0.0, 1.0, 0.0),
                (-0.698, 0.698),
            ),
            JointRow(
                "r_pinky_pip",
                (0.0001, 0.0, -0.0336),
                (1.0, 0.0, 0.0, -1.81365e-05),
                (1.0, 0.0, 0.0),
                (-1.047, 2.094),
            ),
            JointRow("r_pinky_dip", (0.0, 0.0, -0.0275), _NO_TURN, (1.0, 0.0, 0.0), (-1.047, 1.57)),
        ),
        (0.0, 0.0, -0.02475),
        _POINTS,
    ),
)
