/* A libsurvive with two objects and a base station, whose updates a test makes.
   Functions and structures are those of survive_api.h. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef double FLT;
typedef struct { FLT Pos[3]; FLT Rot[4]; } SurvivePose; /* metres; w x y z */
typedef struct Object {
  const char *name, *serial;
  bool has_update;
  FLT time;
  SurvivePose pose;
} Object;

static Object objects[] = {
    {"T20", "LHR-1A2B3C4D"}, {"LH0", "LHB-BASE"}, {"WM0", "LHR-5E6F7A8B"}};
static const int num_objects = 3;
static bool running, refuses;
static int num_arguments;

void *survive_simple_init(int argc, char *const *argv) {
  num_arguments = argv[argc] == NULL ? argc : -1;
  return refuses ? NULL : objects;
}
void survive_simple_start_thread(void *context) { running = true; }
void survive_simple_close(void *context) { running = false; }
bool survive_simple_is_running(void *context) { return running; }
const Object *survive_simple_get_first_object(void *context) { return objects; }
const Object *survive_simple_get_next_object(void *context, const Object *one) {
  return one + 1 < objects + num_objects ? one + 1 : NULL;
}
const Object *survive_simple_get_next_updated(void *context) {
  for (Object *one = objects; one < objects + num_objects; one++)
    if (one->has_update) {
      one->has_update = false;
      return one;
    }
  return NULL;
}
FLT survive_simple_object_get_latest_pose(const Object *one, SurvivePose *pose) {
  *pose = one->pose;
  return one->time;
}
const char *survive_simple_object_name(const Object *one) { return one->name; }
const char *survive_simple_serial_number(const Object *one) { return one->serial; }

/* For tests. */
void test_update(int index, FLT time, FLT x, FLT y, FLT z, FLT qw, FLT qx, FLT qy, FLT qz) {
  objects[index].pose = (SurvivePose){{x, y, z}, {qw, qx, qy, qz}};
  objects[index].time = time;
  objects[index].has_update = true;
}
void test_end(void) { running = false; }
void test_refuse(bool is_refused) { refuses = is_refused; }
int test_arguments(void) { return num_arguments; }
