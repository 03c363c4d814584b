/* A falling body with thrust, by closed form over a step of constant thrust. FMI 2.0 or, with -DFMI3, 3.0.
   References: 0 height_m, 1 speed_m_s (up), 2 thrust_m_s2, 3 gravity_m_s2, 4 trouble (1 crash, 2 NaN, 3 error, 4 hang). */

#include <stdlib.h>
#ifdef FMI3
#include "fmi3Functions.h"
typedef fmi3Instance Unit;
typedef fmi3Status Status;
typedef fmi3Float64 Real;
typedef fmi3ValueReference Reference;
enum { OK = fmi3OK, ERROR = fmi3Error };
#else
#include "fmi2Functions.h"
typedef fmi2Component Unit;
typedef fmi2Status Status;
typedef fmi2Real Real;
typedef fmi2ValueReference Reference;
enum { OK = fmi2OK, ERROR = fmi2Error };
#endif

typedef struct { Real value[5]; } Body;

static Unit made(void) {
    Body *body = calloc(1, sizeof *body);
    body->value[0] = 100.0;
    body->value[3] = 1.62;
    return body;
}

static Status get(Unit unit, const Reference *which, size_t count, Real *out) {
    for (size_t k = 0; k < count; k++) out[k] = ((Body *)unit)->value[which[k]];
    return OK;
}

static Status set(Unit unit, const Reference *which, size_t count, const Real *in) {
    for (size_t k = 0; k < count; k++) ((Body *)unit)->value[which[k]] = in[k];
    return OK;
}

static Status step(Unit unit, Real h) {
    Real *value = ((Body *)unit)->value, a = value[2] - value[3];
    if (value[4] == 1) *(volatile int *)0 = 1;
    if (value[4] == 2) { value[0] = __builtin_nan(""); return OK; }
    if (value[4] == 3) return ERROR;
    while (value[4] == 4) { }
    value[0] += value[1] * h + a * h * h / 2;
    value[1] += a * h;
    return OK;
}

#ifdef FMI3
fmi3Instance fmi3InstantiateCoSimulation(fmi3String a, fmi3String b, fmi3String c, fmi3Boolean d, fmi3Boolean e,
    fmi3Boolean f, fmi3Boolean g, const fmi3ValueReference *h, size_t i, fmi3InstanceEnvironment j,
    fmi3LogMessageCallback k, fmi3IntermediateUpdateCallback l) { return made(); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance u, fmi3Boolean a, fmi3Float64 b, fmi3Float64 c, fmi3Boolean d,
    fmi3Float64 e) { return fmi3OK; }
fmi3Status fmi3ExitInitializationMode(fmi3Instance u) { return fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance u, const fmi3ValueReference v[], size_t n, fmi3Float64 out[], size_t m) {
    return get(u, v, n, out); }
fmi3Status fmi3SetFloat64(fmi3Instance u, const fmi3ValueReference v[], size_t n, const fmi3Float64 in[], size_t m) {
    return set(u, v, n, in); }
fmi3Status fmi3DoStep(fmi3Instance u, fmi3Float64 t, fmi3Float64 h, fmi3Boolean a, fmi3Boolean *b, fmi3Boolean *c,
    fmi3Boolean *d, fmi3Float64 *e) { *b = *c = *d = 0; *e = t + h; return step(u, h); }
#else
fmi2Component fmi2Instantiate(fmi2String a, fmi2Type b, fmi2String c, fmi2String d, const fmi2CallbackFunctions *e,
    fmi2Boolean f, fmi2Boolean g) { return made(); }
fmi2Status fmi2SetupExperiment(fmi2Component u, fmi2Boolean a, fmi2Real b, fmi2Real c, fmi2Boolean d, fmi2Real e) {
    return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component u) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component u) { return fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component u, const fmi2ValueReference v[], size_t n, fmi2Real out[]) {
    return get(u, v, n, out); }
fmi2Status fmi2SetReal(fmi2Component u, const fmi2ValueReference v[], size_t n, const fmi2Real in[]) {
    return set(u, v, n, in); }
fmi2Status fmi2DoStep(fmi2Component u, fmi2Real t, fmi2Real h, fmi2Boolean a) { return step(u, h); }
#endif
