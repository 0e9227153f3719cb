/* @title@ as a level-2 S-function. Made by fpirhc.

       mex CFLAGS='$CFLAGS -ffp-contract=off' -I. @name@_sfun.c @sources@

   Without fused multiplications the bits are those of fpirhc; Microsoft's compiler has /fp:precise for it, its default.

   Input ports, in this order: @ports@. Output ports: the command, its status (0: OK).
   Parameters of the block, in this order: @settings@. They may be changed while a model runs.
   The command follows from the inputs of its own sample; the memory moves on in mdlUpdate. */

#define S_FUNCTION_NAME @name@_sfun
#define S_FUNCTION_LEVEL 2

#include "simstruc.h"

#include "@name@.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { PORTS = @count@, SETTINGS = @live@ };
static const int WIDTHS[PORTS] = {@widths@};

typedef struct {
  @name@_controller c;
  @name@_memory before; /* the memory at the beginning of the cycle */
} block;

static void mdlInitializeSizes(SimStruct* S) {
  int k;
  ssSetNumSFcnParams(S, SETTINGS);
  if (ssGetNumSFcnParams(S) != ssGetSFcnParamsCount(S)) return;
  for (k = 0; k < SETTINGS; ++k) ssSetSFcnParamTunable(S, k, 1);
  if (!ssSetNumInputPorts(S, PORTS) || !ssSetNumOutputPorts(S, 2)) return;
  for (k = 0; k < PORTS; ++k) {
    ssSetInputPortWidth(S, k, WIDTHS[k]);
    ssSetInputPortRequiredContiguous(S, k, 1);
    ssSetInputPortDirectFeedThrough(S, k, 1);
  }
  ssSetOutputPortWidth(S, 0, @NAME@_COMMANDS);
  ssSetOutputPortWidth(S, 1, 1);
  ssSetNumSampleTimes(S, 1);
  ssSetNumPWork(S, 1);
}

static void mdlInitializeSampleTimes(SimStruct* S) {
  ssSetSampleTime(S, 0, @NAME@_PERIOD);
  ssSetOffsetTime(S, 0, 0.0);
}

#if @live@
static const char* const PATHS[] = {@paths@};

/* A parameter of the block; NaN, which no setting takes, where it is no number. */
static double number(SimStruct* S, int k) {
  const mxArray* p = ssGetSFcnParam(S, k);
  int one = mxIsDouble(p) && !mxIsComplex(p) && !mxIsSparse(p) && mxGetNumberOfElements(p) == 1;
  return one ? *mxGetPr(p) : mxGetNaN();
}

/* Put the parameters in force; those that are refused are an error. Twice, since an interval may move beyond its old end. */
static void put(SimStruct* S, @name@_controller* c) {
  static char text[256];
  int k, twice, refused = -1;
  for (twice = 0; twice < 2; ++twice)
    for (k = 0, refused = -1; k < SETTINGS; ++k)
      if (!@name@_set(c, (@name@_setting)k, number(S, k))) refused = k;
  if (refused < 0) return;
  sprintf(text, "@name@: %.180s is no number, or outside its bounds", PATHS[refused]);
  ssSetErrorStatus(S, text);
}

/* NULL before the start, which puts the parameters itself. */
static block* started(SimStruct* S) { return ssGetPWork(S) ? (block*)ssGetPWorkValue(S, 0) : NULL; }

/* Simulink asks before it takes a change, which is tried and taken back. */
#define MDL_CHECK_PARAMETERS
static void mdlCheckParameters(SimStruct* S) {
  block* b = started(S);
  @name@_settings kept;
  if (!b) return;
  kept = b->c.settings;
  put(S, &b->c);
  b->c.settings = kept;
}

#define MDL_PROCESS_PARAMETERS
static void mdlProcessParameters(SimStruct* S) {
  if (started(S)) put(S, &started(S)->c);
}
#endif

#define MDL_START
static void mdlStart(SimStruct* S) {
  block* b = (block*)calloc(1, sizeof *b);
  ssSetPWorkValue(S, 0, b);
  if (!b) {
    ssSetErrorStatus(S, "@name@: there is no memory for the controller");
    return;
  }
  @name@_init(&b->c);
#if @live@
  put(S, &b->c);
#endif
  b->before = b->c.memory;
}

static void mdlOutputs(SimStruct* S, int_T tid) {
  block* b = (block*)ssGetPWorkValue(S, 0);
  @name@_inputs in;
  @name@_command out;
  casadi_real *sample = (casadi_real*)&in, *command = (casadi_real*)&out;
  int k, j;
  (void)tid;
  *sample++ = ssGetT(S);
  for (k = 0; k < PORTS; ++k) {
    const real_T* port = ssGetInputPortRealSignal(S, k);
    for (j = 0; j < WIDTHS[k]; ++j) *sample++ = port[j];
  }
  b->c.memory = b->before;
  *ssGetOutputPortRealSignal(S, 1) = @name@_step(&b->c, &in, &out);
  for (k = 0; k < @NAME@_COMMANDS; ++k) ssGetOutputPortRealSignal(S, 0)[k] = command[k];
}

#define MDL_UPDATE
static void mdlUpdate(SimStruct* S, int_T tid) {
  block* b = (block*)ssGetPWorkValue(S, 0);
  (void)tid;
  b->before = b->c.memory;
}

static void mdlTerminate(SimStruct* S) { free(ssGetPWorkValue(S, 0)); }

#ifdef MATLAB_MEX_FILE
#include "simulink.c"
#else
#include "cg_sfun.h"
#endif
