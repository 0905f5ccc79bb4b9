from collections.abc import Callable
from enum import IntEnum

import numpy as np

__version__: str

class mjtObj(IntEnum):
    mjOBJ_BODY = 1
    mjOBJ_JOINT = 3
    mjOBJ_ACTUATOR = 19

class mjtJoint(IntEnum):
    mjJNT_FREE = 0
    mjJNT_SLIDE = 2
    mjJNT_HINGE = 3

class mjtGeom(IntEnum):
    mjGEOM_SPHERE = 2
    mjGEOM_CAPSULE = 3
    mjGEOM_ELLIPSOID = 4
    mjGEOM_CYLINDER = 5
    mjGEOM_BOX = 6
    mjGEOM_MESH = 7

class mjtState(IntEnum):
    mjSTATE_INTEGRATION = 32767

class mjtCone(IntEnum):
    mjCONE_PYRAMIDAL = 0

class mjtSolver(IntEnum):
    mjSOL_CG = 1

class mjtDisableBit(IntEnum):
    mjDSBL_SENSOR = 8192

class _Named:
    id: int

class _Option:
    timestep: float
    disableflags: int
    iterations: int
    solver: int
    cone: int

class _Contacts:
    geom: np.ndarray
    pos: np.ndarray

class MjModel:
    opt: _Option
    nq: int
    nv: int
    nu: int
    nbody: int
    ngeom: int
    body_dofadr: np.ndarray
    body_dofnum: np.ndarray
    body_jntadr: np.ndarray
    body_jntnum: np.ndarray
    body_mocapid: np.ndarray
    body_parentid: np.ndarray
    body_rootid: np.ndarray
    geom_bodyid: np.ndarray
    geom_dataid: np.ndarray
    geom_rgba: np.ndarray
    jnt_axis: np.ndarray
    geom_size: np.ndarray
    geom_pos: np.ndarray
    geom_quat: np.ndarray
    geom_aabb: np.ndarray
    geom_rbound: np.ndarray
    geom_group: np.ndarray
    body_bvhadr: np.ndarray
    body_bvhnum: np.ndarray
    bvh_aabb: np.ndarray
    geom_type: np.ndarray
    jnt_dofadr: np.ndarray
    jnt_qposadr: np.ndarray
    jnt_type: np.ndarray
    mesh_vert: np.ndarray
    mesh_vertadr: np.ndarray
    mesh_vertnum: np.ndarray
    sensor_adr: np.ndarray
    @staticmethod
    def from_xml_string(xml: str) -> MjModel: ...
    def geom(self, name: str) -> _Named: ...
    def body(self, name: str) -> _Named: ...
    def sensor(self, name: str) -> _Named: ...

class MjData:
    ncon: int
    contact: _Contacts
    ctrl: np.ndarray
    geom_xmat: np.ndarray
    geom_xpos: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    sensordata: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    def __init__(self, model: MjModel) -> None: ...

def mj_contactForce(m: MjModel, d: MjData, id: int, result: np.ndarray) -> None: ...
def mj_forward(m: MjModel, d: MjData) -> None: ...
def mj_getState(m: MjModel, d: MjData, state: np.ndarray, sig: int) -> None: ...
def mj_kinematics(m: MjModel, d: MjData) -> None: ...
def mj_multiRay(
    m: MjModel,
    d: MjData,
    pnt: np.ndarray,
    vec: np.ndarray,
    geomgroup: np.ndarray | None,
    flg_static: int,
    bodyexclude: int,
    geomid: np.ndarray,
    dist: np.ndarray,
    normal: np.ndarray | None,
    nray: int,
    cutoff: float,
) -> None: ...
def mj_name2id(m: MjModel, type: int, name: str) -> int: ...
def mj_resetData(m: MjModel, d: MjData) -> None: ...
def mj_setState(m: MjModel, d: MjData, state: np.ndarray, sig: int) -> None: ...
def mj_stateSize(m: MjModel, sig: int) -> int: ...
def mj_step(m: MjModel, d: MjData) -> None: ...
def set_mju_user_warning(handler: Callable[[str], None]) -> None: ...
