/* A thin layer over Munk2D for munk.js: plain numbers in, plain numbers out.

Reads bodies, shapes and joints as numbers; gives handles (addresses) and the bodies' states. Each
function makes the calls that pymunk makes for the same thing, in the same order, so that a drive
has the same numbers here and there. */

#include "chipmunk/chipmunk.h"
#include "chipmunk/chipmunk_unsafe.h"

#define EXPORT(name) __attribute__((export_name(#name))) name

/* Munk2D's assertions end here: stop at once, as JavaScript sees it with a RuntimeError. */
void cpMessage(const char *condition, const char *file, int line, int is_error, int is_hard,
               const char *message, ...) {
  if (is_error) __builtin_trap();
}

static double state[6];

double *EXPORT(state_address)(void) { return state; }

cpSpace *EXPORT(space_new)(double gravity, int iterations) {
  cpSpace *space = cpSpaceNew();
  cpSpaceSetGravity(space, cpv(0.0, gravity));
  cpSpaceSetIterations(space, iterations);
  return space;
}

/* Add a body at (x, y) with its shape. Bodies of one robot share a group: they never touch. */
static cpBody *add(cpSpace *space, cpBody *body, cpShape *shape, double x, double y,
                   double friction) {
  cpShapeSetFriction(shape, friction);
  cpShapeSetFilter(shape, cpShapeFilterNew(1, CP_ALL_CATEGORIES, CP_ALL_CATEGORIES));
  cpBodySetPosition(body, cpv(x, y));
  cpSpaceAddBody(space, body);
  cpSpaceAddShape(space, shape);
  return body;
}

cpBody *EXPORT(box)(cpSpace *space, double x, double y, double mass, double length, double height,
                    double radius, double friction) {
  cpBody *body = cpBodyNew(mass, cpMomentForBox(mass, length, height));
  return add(space, body, cpBoxShapeNew(body, length, height, radius), x, y, friction);
}

cpBody *EXPORT(circle)(cpSpace *space, double x, double y, double mass, double radius,
                       double friction) {
  cpBody *body = cpBodyNew(mass, cpMomentForCircle(mass, 0.0, radius, cpvzero));
  return add(space, body, cpCircleShapeNew(body, radius, cpvzero), x, y, friction);
}

void EXPORT(body_set)(cpSpace *space, cpBody *body, double x, double y, double angle) {
  cpBodySetPosition(body, cpv(x, y));
  cpBodySetAngle(body, angle);
  cpBodySetVelocity(body, cpvzero);
  cpBodySetAngularVelocity(body, 0.0);
  cpSpaceReindexShapesForBody(space, body);
}

/* Write x, y, angle, vx, vy and the angular velocity to `state`. */
void EXPORT(body_read)(cpBody *body) {
  cpVect at = cpBodyGetPosition(body), v = cpBodyGetVelocity(body);
  state[0] = at.x, state[1] = at.y, state[2] = cpBodyGetAngle(body);
  state[3] = v.x, state[4] = v.y, state[5] = cpBodyGetAngularVelocity(body);
}

/* The wheel slides on a line from `near` to `far` below the chassis, at `hip` along it. */
void EXPORT(groove)(cpSpace *space, cpBody *chassis, cpBody *wheel, double hip, double near,
                    double far) {
  cpSpaceAddConstraint(
      space, cpGrooveJointNew(chassis, wheel, cpv(hip, -near), cpv(hip, -far), cpvzero));
}

cpConstraint *EXPORT(spring)(cpSpace *space, cpBody *chassis, cpBody *wheel, double hip,
                             double rest, double stiffness, double damping) {
  return cpSpaceAddConstraint(space, cpDampedSpringNew(chassis, wheel, cpv(hip, 0.0), cpvzero,
                                                       rest, stiffness, damping));
}

cpConstraint *EXPORT(motor)(cpSpace *space, cpBody *chassis, cpBody *wheel, double torque) {
  cpConstraint *motor = cpSimpleMotorNew(chassis, wheel, 0.0);
  cpConstraintSetMaxForce(motor, torque);
  return cpSpaceAddConstraint(space, motor);
}

void EXPORT(spring_rest)(cpConstraint *spring, double rest) {
  cpDampedSpringSetRestLength(spring, rest);
}

void EXPORT(motor_rate)(cpConstraint *motor, double rate) { cpSimpleMotorSetRate(motor, rate); }

cpShape *EXPORT(segment)(cpSpace *space, double x, double y, double friction) {
  cpShape *shape = cpSegmentShapeNew(cpSpaceGetStaticBody(space), cpv(x, y), cpv(x, y), 0.0);
  cpShapeSetFriction(shape, friction);
  return cpSpaceAddShape(space, shape);
}

void EXPORT(segment_move)(cpSpace *space, cpShape *shape, double x0, double y0, double x1,
                          double y1) {
  cpSegmentShapeSetEndpoints(shape, cpv(x0, y0), cpv(x1, y1));
  cpSpaceReindexShape(space, shape);
}

void EXPORT(space_step)(cpSpace *space, double dt, int times) {
  for (int i = 0; i < times; i++) cpSpaceStep(space, dt);
}
