/*
 * Copyright (c) The acados authors.
 *
 * This file is part of acados.
 *
 * The 2-Clause BSD License
 *
 * Redistribution and use in source and binary forms, with or without
 * modification, are permitted provided that the following conditions are met:
 *
 * 1. Redistributions of source code must retain the above copyright notice,
 * this list of conditions and the following disclaimer.
 *
 * 2. Redistributions in binary form must reproduce the above copyright notice,
 * this list of conditions and the following disclaimer in the documentation
 * and/or other materials provided with the distribution.
 *
 * THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS AND CONTRIBUTORS "AS IS"
 * AND ANY EXPRESS OR IMPLIED WARRANTIES, INCLUDING, BUT NOT LIMITED TO, THE
 * IMPLIED WARRANTIES OF MERCHANTABILITY AND FITNESS FOR A PARTICULAR PURPOSE
 * ARE DISCLAIMED. IN NO EVENT SHALL THE COPYRIGHT HOLDER OR CONTRIBUTORS BE
 * LIABLE FOR ANY DIRECT, INDIRECT, INCIDENTAL, SPECIAL, EXEMPLARY, OR
 * CONSEQUENTIAL DAMAGES (INCLUDING, BUT NOT LIMITED TO, PROCUREMENT OF
 * SUBSTITUTE GOODS OR SERVICES; LOSS OF USE, DATA, OR PROFITS; OR BUSINESS
 * INTERRUPTION) HOWEVER CAUSED AND ON ANY THEORY OF LIABILITY, WHETHER IN
 * CONTRACT, STRICT LIABILITY, OR TORT (INCLUDING NEGLIGENCE OR OTHERWISE)
 * ARISING IN ANY WAY OUT OF THE USE OF THIS SOFTWARE, EVEN IF ADVISED OF THE
 * POSSIBILITY OF SUCH DAMAGE.;
 */

#ifndef ACADOS_SOLVER_horizon4_H_
#define ACADOS_SOLVER_horizon4_H_

#include "acados/utils/types.h"

#include "acados_c/ocp_nlp_interface.h"
#include "acados_c/external_function_interface.h"

#define HORIZON4_NX     9
#define HORIZON4_NZ     0
#define HORIZON4_NU     3
#define HORIZON4_NP     17
#define HORIZON4_NBX    2
#define HORIZON4_NBX0   9
#define HORIZON4_NBU    3
#define HORIZON4_NSBX   0
#define HORIZON4_NSBU   0
#define HORIZON4_NSH    0
#define HORIZON4_NSG    0
#define HORIZON4_NSPHI  0
#define HORIZON4_NSHN   0
#define HORIZON4_NSGN   0
#define HORIZON4_NSPHIN 0
#define HORIZON4_NSBXN  0
#define HORIZON4_NS     0
#define HORIZON4_NSN    0
#define HORIZON4_NG     0
#define HORIZON4_NBXN   2
#define HORIZON4_NGN    0
#define HORIZON4_NY0    0
#define HORIZON4_NY     0
#define HORIZON4_NYN    0
#define HORIZON4_N      40
#define HORIZON4_NH     0
#define HORIZON4_NPHI   0
#define HORIZON4_NHN    0
#define HORIZON4_NPHIN  0
#define HORIZON4_NR     0

#ifdef __cplusplus
extern "C" {
#endif


// ** capsule for solver data **
typedef struct horizon4_solver_capsule
{
    // acados objects
    ocp_nlp_in *nlp_in;
    ocp_nlp_out *nlp_out;
    ocp_nlp_out *sens_out;
    ocp_nlp_solver *nlp_solver;
    void *nlp_opts;
    ocp_nlp_plan_t *nlp_solver_plan;
    ocp_nlp_config *nlp_config;
    ocp_nlp_dims *nlp_dims;

    // number of expected runtime parameters
    unsigned int nlp_np;

    /* external functions */
    // dynamics

    external_function_param_casadi *discr_dyn_phi_fun;
    external_function_param_casadi *discr_dyn_phi_fun_jac_ut_xt;


    // cost

    external_function_param_casadi *ext_cost_fun;
    external_function_param_casadi *ext_cost_fun_jac;
    external_function_param_casadi *ext_cost_fun_jac_hess;



    external_function_param_casadi ext_cost_0_fun;
    external_function_param_casadi ext_cost_0_fun_jac;
    external_function_param_casadi ext_cost_0_fun_jac_hess;


    external_function_param_casadi ext_cost_e_fun;
    external_function_param_casadi ext_cost_e_fun_jac;
    external_function_param_casadi ext_cost_e_fun_jac_hess;

    // constraints




} horizon4_solver_capsule;

ACADOS_SYMBOL_EXPORT horizon4_solver_capsule * horizon4_acados_create_capsule(void);
ACADOS_SYMBOL_EXPORT int horizon4_acados_free_capsule(horizon4_solver_capsule *capsule);

ACADOS_SYMBOL_EXPORT int horizon4_acados_create(horizon4_solver_capsule * capsule);

ACADOS_SYMBOL_EXPORT int horizon4_acados_reset(horizon4_solver_capsule* capsule, int reset_qp_solver_mem);

/**
 * Generic version of horizon4_acados_create which allows to use a different number of shooting intervals than
 * the number used for code generation. If new_time_steps=NULL and n_time_steps matches the number used for code
 * generation, the time-steps from code generation is used.
 */
ACADOS_SYMBOL_EXPORT int horizon4_acados_create_with_discretization(horizon4_solver_capsule * capsule, int n_time_steps, double* new_time_steps);
/**
 * Update the time step vector. Number N must be identical to the currently set number of shooting nodes in the
 * nlp_solver_plan. Returns 0 if no error occurred and a otherwise a value other than 0.
 */
ACADOS_SYMBOL_EXPORT int horizon4_acados_update_time_steps(horizon4_solver_capsule * capsule, int N, double* new_time_steps);
/**
 * This function is used for updating an already initialized solver with a different number of qp_cond_N.
 */
ACADOS_SYMBOL_EXPORT int horizon4_acados_update_qp_solver_cond_N(horizon4_solver_capsule * capsule, int qp_solver_cond_N);
ACADOS_SYMBOL_EXPORT int horizon4_acados_update_params(horizon4_solver_capsule * capsule, int stage, double *value, int np);
ACADOS_SYMBOL_EXPORT int horizon4_acados_update_params_sparse(horizon4_solver_capsule * capsule, int stage, int *idx, double *p, int n_update);

ACADOS_SYMBOL_EXPORT int horizon4_acados_solve(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT int horizon4_acados_free(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT void horizon4_acados_print_stats(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT int horizon4_acados_custom_update(horizon4_solver_capsule* capsule, double* data, int data_len);


ACADOS_SYMBOL_EXPORT ocp_nlp_in *horizon4_acados_get_nlp_in(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_out *horizon4_acados_get_nlp_out(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_out *horizon4_acados_get_sens_out(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_solver *horizon4_acados_get_nlp_solver(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_config *horizon4_acados_get_nlp_config(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT void *horizon4_acados_get_nlp_opts(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_dims *horizon4_acados_get_nlp_dims(horizon4_solver_capsule * capsule);
ACADOS_SYMBOL_EXPORT ocp_nlp_plan_t *horizon4_acados_get_nlp_plan(horizon4_solver_capsule * capsule);

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif  // ACADOS_SOLVER_horizon4_H_
