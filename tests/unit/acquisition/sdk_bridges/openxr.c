/* An OpenXR loader with a runtime of two hands, which a test moves.
   Structures and numbers are those of openxr.h 1.0. Wrong types of structures, unknown handles and
   calls out of order are refused, as a validation layer does. It is also a runtime, which the real
   loader loads. */
#define _GNU_SOURCE
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

enum { SUCCESS = 0, EVENT_UNAVAILABLE = 4, INVALID = -1, NO_EXTENSION = -9, LOST = -17,
       UNSUPPORTED = -7, NO_FORM_FACTOR = -35 };
enum { INSTANCE = 0x11, SESSION = 0x22, SPACE = 0x33, TRACKER = 0x40, SYSTEM = 7 };
typedef int32_t Result;
typedef uint64_t Handle;
typedef struct { int32_t type; void *next; } Base;
typedef struct {
  Base base;
  uint64_t flags;
  struct { char name[128]; uint32_t version; char engine[128]; uint32_t engineVersion;
           uint64_t api; } application;
  uint32_t layerCount;
  const char *const *layers;
  uint32_t extensionCount;
  const char *const *extensions;
} InstanceCreateInfo;
typedef struct { Base base; int32_t formFactor; } SystemGetInfo;
typedef struct { Base base; uint64_t flags, system; } SessionCreateInfo;
typedef struct { Base base; int32_t views; } SessionBeginInfo;
typedef struct { float x, y, z, w; } Quaternionf;
typedef struct { float x, y, z; } Vector3f;
typedef struct { Quaternionf orientation; Vector3f position; } Posef;
typedef struct { Base base; int32_t space; Posef pose; } ReferenceSpaceCreateInfo;
typedef struct { Base base; uint8_t varying[4000]; } EventDataBuffer;
typedef struct { Base base; Handle session; int32_t state; int64_t time; } StateChanged;
typedef struct { Base base; int32_t hand, set; } TrackerCreateInfo;
typedef struct { Base base; Handle space; int64_t time; } LocateInfo;
typedef struct { uint64_t flags; Posef pose; float radius; } JointLocation;
typedef struct { Base base; uint32_t isActive, count; JointLocation *joints; } JointLocations;

static bool has_runtime = true, exists, has_begun;
static int events[8], num_events;
static struct { bool isActive; JointLocation joints[26]; } hands[2];
static int64_t last_request;
/* XrTime has an origin of its own. */
static const int64_t origin = 123456789;

Result xrCreateInstance(const InstanceCreateInfo *info, Handle *instance) {
  if (!has_runtime) return LOST;
  int found = 0;
  if (info->base.type != 3 || info->application.api >> 48 != 1 || !info->application.name[0])
    return INVALID;
  for (uint32_t i = 0; i < info->extensionCount; i++)
    found += !strcmp(info->extensions[i], "XR_EXT_hand_tracking") ||
             !strcmp(info->extensions[i], "XR_MND_headless") ||
             !strcmp(info->extensions[i], "XR_KHR_convert_timespec_time");
  if (found != 3) return NO_EXTENSION;
  *instance = INSTANCE, exists = true, has_begun = false, num_events = 0;
  return SUCCESS;
}
Result xrDestroyInstance(Handle instance) { return exists = false, SUCCESS; }
Result xrGetSystem(Handle instance, const SystemGetInfo *info, uint64_t *system) {
  if (info->base.type != 4) return INVALID;
  *system = SYSTEM;
  return info->formFactor == 1 ? SUCCESS : NO_FORM_FACTOR;
}
Result xrCreateSession(Handle instance, const SessionCreateInfo *info, Handle *session) {
  if (info->base.type != 8 || info->base.next || info->system != SYSTEM) return INVALID;
  *session = SESSION, events[num_events++] = 1, events[num_events++] = 2; /* idle, ready */
  return SUCCESS;
}
Result xrBeginSession(Handle session, const SessionBeginInfo *info) {
  if (session != SESSION || info->base.type != 10 || info->views != 2 || has_begun) return INVALID;
  has_begun = true;
  for (int state = 3; state <= 5; state++) events[num_events++] = state; /* … focused */
  return SUCCESS;
}
Result xrCreateReferenceSpace(Handle session, const ReferenceSpaceCreateInfo *info, Handle *space) {
  if (session != SESSION || info->base.type != 37 || info->space != 2) return INVALID;
  *space = SPACE;
  return info->pose.orientation.w == 1 ? SUCCESS : INVALID;
}
Result xrPollEvent(Handle instance, EventDataBuffer *event) {
  if (!exists || !has_runtime) return LOST;
  if (event->base.type != 16) return INVALID;
  if (num_events == 0) return EVENT_UNAVAILABLE;
  *(StateChanged *)event = (StateChanged){{18, NULL}, SESSION, events[0], 0};
  memmove(events, events + 1, --num_events * sizeof *events);
  return SUCCESS;
}
static Result create_tracker(Handle session, const TrackerCreateInfo *info, Handle *tracker) {
  if (session != SESSION || info->base.type != 1000051001 || info->set != 0) return INVALID;
  *tracker = TRACKER + info->hand;
  return info->hand == 1 || info->hand == 2 ? SUCCESS : INVALID;
}
static Result locate(Handle tracker, const LocateInfo *info, JointLocations *found) {
  if (info->base.type != 1000051002 || found->base.type != 1000051003 || found->count != 26 ||
      info->space != SPACE || info->time <= 0)
    return INVALID;
  int hand = tracker - TRACKER - 1;
  found->isActive = has_begun && hands[hand].isActive;
  memcpy(found->joints, hands[hand].joints, sizeof hands[hand].joints);
  last_request = info->time;
  return SUCCESS;
}
static Result convert(Handle instance, const struct timespec *t, int64_t *time) {
  *time = t->tv_sec * 1000000000LL + t->tv_nsec + origin;
  return instance == INSTANCE ? SUCCESS : INVALID;
}
static Result extensions(const char *layer, uint32_t capacity, uint32_t *count, char *properties) {
  static const char *names[] = {"XR_EXT_hand_tracking", "XR_MND_headless",
                                "XR_KHR_convert_timespec_time"};
  *count = 3;
  /* XrExtensionProperties: type, next, name of 128, version. */
  for (uint32_t i = 0; i < 3 && capacity; i++) strcpy(properties + 152 * i + 16, names[i]);
  return SUCCESS;
}
Result xrGetInstanceProcAddr(Handle instance, const char *name, void **function) {
  static const struct { const char *name; void *function; } table[] = {
      {"xrCreateInstance", xrCreateInstance}, {"xrDestroyInstance", xrDestroyInstance},
      {"xrGetSystem", xrGetSystem}, {"xrCreateSession", xrCreateSession},
      {"xrBeginSession", xrBeginSession}, {"xrCreateReferenceSpace", xrCreateReferenceSpace},
      {"xrPollEvent", xrPollEvent}, {"xrCreateHandTrackerEXT", create_tracker},
      {"xrLocateHandJointsEXT", locate}, {"xrConvertTimespecTimeToTimeKHR", convert},
      {"xrEnumerateInstanceExtensionProperties", extensions},
      {"xrGetInstanceProcAddr", xrGetInstanceProcAddr}};
  for (size_t i = 0; i < sizeof table / sizeof *table; i++)
    if (!strcmp(name, table[i].name)) return *function = table[i].function, SUCCESS;
  return *function = NULL, UNSUPPORTED;
}
/* XrNegotiateRuntimeRequest of openxr_loader_negotiation.h. */
typedef struct { int type; uint32_t version; size_t size; uint32_t interface; uint64_t api;
                 void *getProcAddr; } RuntimeRequest;
Result xrNegotiateLoaderRuntimeInterface(const void *loader, RuntimeRequest *request) {
  request->interface = 1, request->api = 1ull << 48, request->getProcAddr = xrGetInstanceProcAddr;
  return SUCCESS;
}

/* For tests. Of each joint its flags and position x y z (m) and quaternion x y z w. */
void test_hand(int hand, int is_active, const uint64_t *flags, const float *poses) {
  hands[hand].isActive = is_active;
  for (int joint = 0; joint < 26; joint++) {
    const float *p = poses + 7 * joint;
    hands[hand].joints[joint] =
        (JointLocation){flags[joint], {{p[3], p[4], p[5], p[6]}, {p[0], p[1], p[2]}}, 0.01f};
  }
}
void test_state(int state) { events[num_events++] = state; }
void test_runtime(int is_there) { has_runtime = is_there; }
int64_t test_request(void) { return last_request - origin; }
