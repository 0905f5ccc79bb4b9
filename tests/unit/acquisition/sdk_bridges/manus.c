/* A MANUS Core SDK in integrated mode, whose gloves a test moves.
   Functions, structures and numbers are those of ManusSDK.h and ManusSDKTypes.h. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

typedef enum { Success, Error, InvalidArgument, ArgumentSizeMismatch, NotConnected = 11 } Code;
typedef struct { float x, y, z; } ManusVec3;
typedef struct { float w, x, y, z; } ManusQuaternion;
typedef struct { ManusVec3 position; ManusQuaternion rotation; ManusVec3 scale; } ManusTransform;
typedef struct { uint32_t id; ManusTransform transform; } SkeletonNode;
typedef struct { uint64_t time; } ManusTimestamp;
typedef struct { uint32_t gloveId, nodesCount; ManusTimestamp publishTime; } RawSkeletonInfo;
typedef struct { ManusTimestamp publishTime; uint32_t skeletonsCount; } SkeletonStreamInfo;
typedef struct { uint32_t nodeId, parentId; int chainType, side, fingerJointType; } NodeInfo;
typedef struct { int view, up, handedness; float unitScale; } CoordinateSystemVUH;
typedef struct { uint32_t major, minor, patch; char label[16], sha[16], tag[16]; } Version;
typedef struct { char hostName[256], ipAddress[40]; Version manusCoreVersion; } ManusHost;
typedef void (*RawSkeletonStreamCallback_t)(const SkeletonStreamInfo *const);

#define NUM_NODES 25
#define NUM_GLOVES 3
/* Enumerations of the header, by hand: chains thumb 5 … pinky 9, hand 13; joints metacarpal 1,
   proximal 2, intermediate 3, distal 4, tip 5. The order is that of Linux: pinky, thumb, index,
   ring, middle. Ids say nothing. */
static const int chains[NUM_NODES] = {13, 9, 9, 9, 9, 9, 5, 5, 5, 5, 6, 6, 6,
                                      6,  6, 8, 8, 8, 8, 8, 7, 7, 7, 7, 7};
static const int joints[NUM_NODES] = {0, 1, 2, 3, 4, 5, 1, 2, 4, 5, 1, 2, 3,
                                      4, 5, 1, 2, 3, 4, 5, 1, 2, 3, 4, 5};
/* What the joint before the thumb's tip is called: distal, or intermediate. */
static int thumb_joint = 4;
static uint32_t node_id(int node) { return 1000 + 7 * node; }

static RawSkeletonStreamCallback_t callback;
static CoordinateSystemVUH axes;
static bool initialized, connected, in_world;
static int hand_motion = -1;
static uint64_t now;
static struct { uint32_t id; int side; bool streams; SkeletonNode nodes[NUM_NODES]; uint64_t time; }
    gloves[NUM_GLOVES] = {{0xA1, 1}, {0xB2, 2}, {0xC3, 1}};

static int glove_of_stream(uint32_t index) {
  for (int glove = 0; glove < NUM_GLOVES; glove++)
    if (gloves[glove].streams && index-- == 0) return glove;
  return -1;
}

Code CoreSdk_InitializeIntegrated(void) { return initialized = true, Success; }
Code CoreSdk_ShutDown(void) {
  callback = NULL;
  initialized = connected = false;
  return Success;
}
Code CoreSdk_RegisterCallbackForRawSkeletonStream(RawSkeletonStreamCallback_t one) {
  callback = one;
  return initialized ? Success : Error;
}
Code CoreSdk_InitializeCoordinateSystemWithVUH(CoordinateSystemVUH wanted, bool is_world) {
  axes = wanted, in_world = is_world;
  return initialized ? Success : Error;
}
void ManusHost_Init(ManusHost *host) { memset(host, 0, sizeof *host), host->hostName[0] = 'h'; }
Code CoreSdk_ConnectToHost(ManusHost host) {
  connected = initialized && host.hostName[0] == 'h' && host.manusCoreVersion.tag[15] == 0;
  return connected ? Success : NotConnected;
}
Code CoreSdk_GetIsConnectedToCore(bool *is_connected) { return *is_connected = connected, Success; }
Code CoreSdk_SetRawSkeletonHandMotion(int motion) { return hand_motion = motion, Success; }
Code CoreSdk_GetRawSkeletonInfo(uint32_t index, RawSkeletonInfo *info) {
  int glove = glove_of_stream(index);
  if (glove < 0) return ArgumentSizeMismatch;
  *info = (RawSkeletonInfo){gloves[glove].id, NUM_NODES, {gloves[glove].time}};
  return Success;
}
Code CoreSdk_GetRawSkeletonData(uint32_t index, SkeletonNode *nodes, uint32_t count) {
  int glove = glove_of_stream(index);
  if (glove < 0 || count != NUM_NODES) return ArgumentSizeMismatch;
  memcpy(nodes, gloves[glove].nodes, sizeof gloves[glove].nodes);
  return Success;
}
Code CoreSdk_GetRawSkeletonNodeInfoArray(uint32_t glove_id, NodeInfo *infos, uint32_t count) {
  if (count != NUM_NODES) return ArgumentSizeMismatch;
  for (int glove = 0; glove < NUM_GLOVES; glove++)
    if (gloves[glove].id == glove_id) {
      /* In another order than the nodes. */
      for (int i = 0; i < NUM_NODES; i++) {
        int node = NUM_NODES - 1 - i;
        infos[i] = (NodeInfo){node_id(node), 0, chains[node], node ? gloves[glove].side : 0,
                              node == 8 ? thumb_joint : joints[node]};
      }
      return Success;
    }
  return InvalidArgument;
}

/* For tests. Positions of the 25 nodes in metres, right-handed with z up, and the wrist's w x y z.
   The SDK gives them in what axes it was asked for. */
void test_move(int glove, const float *positions, const float *wrist, int is_new) {
  bool is_left_handed = axes.handedness == 1;
  for (int node = 0; node < NUM_NODES; node++) {
    const float *p = positions + 3 * node;
    ManusVec3 position = {p[0] / axes.unitScale, p[1] / axes.unitScale, p[2] / axes.unitScale};
    if (is_left_handed) position.y = -position.y;
    gloves[glove].nodes[node] = (SkeletonNode){
        node_id(node), {position, {wrist[0], wrist[1], wrist[2], wrist[3]}, {1, 1, 1}}};
  }
  gloves[glove].streams = true;
  if (is_new) gloves[glove].time = ++now;
}
void test_publish(void) {
  SkeletonStreamInfo info = {{now}, 0};
  for (int glove = 0; glove < NUM_GLOVES; glove++) info.skeletonsCount += gloves[glove].streams;
  if (callback) callback(&info);
}
void test_thumb(int joint) { thumb_joint = joint; }
void test_stop(int glove) { gloves[glove].streams = false; }
void test_disconnect(void) { connected = false; }
/* View, up, handedness, whether in the world, and the motion of the hand. */
int test_axes(int which) {
  int values[] = {axes.view, axes.up, axes.handedness, in_world, hand_motion};
  return values[which];
}
