/* The iteration of FixedPoint as loops around generated stage functions.

   The same mathematics as the composed graph in fixed_point.py and search.py, which is the reference it is tested against:
   names follow those files. What is generated stands before this text: the stage functions evaluate, pull, linearise, hessian, end
   and deformed, the sizes NS, NU, NT (entries of the data of a stage), NM (partial derivatives of a stage), N, the constants of the search, and ENTRY, the name of the function. Matrices are column-major, stages follow each other. Nothing is allocated: what is as long as a
   plan lies in the caller's work, ROOM numbers. */

typedef struct {
  casadi_real u[N * NU], x[(N + 1) * NS], g[N * NU], value;
} Plan;

typedef struct {
  Plan plans[2];
  casadi_real v[N * NU], k[N * NU * NS], t[N * NU], planned[N * NS];
  casadi_real partials[N * NM], lambda[(N + 1) * NS], final[NS * NS];
  casadi_real envelope, reach, tau, gamma, resume;
#ifdef SCALE_AT
  casadi_real metric[NU], first_gamma; /* settings are live: the scale and the first gamma are data of the call */
#endif
} Search;

typedef char search_fits[sizeof(Search) == ROOM * sizeof(casadi_real) ? 1 : -1];

#ifdef SCALE_AT
#define scale (s->metric)
#define FIRST_GAMMA (s->first_gamma)
#else
static const casadi_real scale[NU] = SCALE;
#endif

/* The middle of the limits of an input; 0 without one of them. */
INLINE casadi_real middle(casadi_real low, casadi_real high) {
  return fabs(low) <= FINITE && fabs(high) <= FINITE ? 0.5 * (low + high) : 0;
}

/* Roll out the next plan, with its cost and gradient; 0 when something is not finite. The partial derivatives stay, for the
   Jacobians of a plan that is accepted. */
INLINE int try_next(Search* s, const Plan* best, Plan* plan, In s0, In data, In lower, In upper) {
  int i, j, l, bold = s->tau >= SHORTEST;
  In arg[8];
  Out res[8];
  casadi_real cost, slope[NS];
  plan->value = 0;
  for (j = 0; j < NS; ++j) plan->x[j] = s0[j];
  for (i = 0; i < N; ++i) {
    Out u = plan->u + i * NU, x = plan->x + i * NS;
    casadi_real apart[NS];
    for (j = 0; j < NS; ++j) apart[j] = x[j] - s->planned[i * NS + j];
    for (l = 0; l < NU; ++l) {
      casadi_real wanted = best->u[i * NU + l] + s->tau * s->v[i * NU + l];
      for (j = 0; j < NS; ++j) wanted += s->k[(i * NS + j) * NU + l] * apart[j];
      u[l] = bold ? between(wanted, lower[l], upper[l]) : s->t[i * NU + l];
    }
    arg[0] = x, arg[1] = u, arg[2] = data + i * NT;
    res[0] = x + NS, res[1] = &cost, res[2] = s->partials + i * NM;
    if (evaluate(arg, res, 0, 0, 0)) return 0;
    plan->value += cost;
  }
  arg[0] = plan->x + N * NS, arg[1] = data + N * NT;
  res[0] = &cost, res[1] = slope, res[2] = s->final;
  if (end(arg, res, 0, 0, 0)) return 0;
  plan->value += cost;
  for (j = 0; j < NS; ++j) s->lambda[N * NS + j] = slope[j];
  for (i = N - 1; i >= 0; --i) {
    arg[0] = s->partials + i * NM, arg[1] = s->lambda + (i + 1) * NS;
    res[0] = s->lambda + i * NS, res[1] = plan->g + i * NU;
    if (pull(arg, res, 0, 0, 0)) return 0;
  }
  return all_finite(&plan->value, 1) && all_finite(plan->g, N * NU) && all_finite(plan->x, (N + 1) * NS);
}

/* The plain fixed-point step T = clip(U - gamma D g); returns g'(T - U), and in reach |T - U|^2 / (2 gamma). */
INLINE casadi_real plain_step(Search* s, const Plan* plan, In lower, In upper, casadi_real* reach) {
  int i, l;
  casadi_real descent = 0, size = 0;
  for (i = 0; i < N; ++i)
    for (l = 0; l < NU; ++l) {
      int k = i * NU + l;
      casadi_real move;
      s->t[k] = between(plan->u[k] - s->gamma * scale[l] * plan->g[k], lower[l], upper[l]);
      move = s->t[k] - plan->u[k];
      descent += plan->g[k] * move;
      size += move * move / scale[l];
    }
  *reach = size / (2 * s->gamma);
  return descent;
}

/* Accept the tried plan and return 1, or draw in and return 0. */
INLINE int judged(Search* s, Plan* best, Plan* plan, int ok, In lower, In upper) {
  int i, untried = best->value >= UNTRIED, bold = s->tau >= SHORTEST;
  casadi_real slack = ROUNDING * (1 + fabs(best->value)), reach, envelope = 0, descent = 0, rise = 0;
  if (ok && !untried) {
    if (bold) {
      casadi_real before[N * NU];
      for (i = 0; i < N * NU; ++i) before[i] = s->t[i];
      envelope = plan->value + plain_step(s, plan, lower, upper, &reach) + reach;
      for (i = 0; i < N * NU; ++i) descent += best->g[i] * (plan->u[i] - best->u[i]);
      ok = envelope <= s->envelope - SHARE * (1 - SHARE) * s->reach + slack ||
           plan->value <= best->value + ARMIJO * smaller(descent, 0) + slack;
      ok = ok && envelope <= s->envelope + slack && plan->value <= best->value + slack;
      if (!ok) for (i = 0; i < N * NU; ++i) s->t[i] = before[i];
    } else {
      for (i = 0; i < N * NU; ++i) descent += best->g[i] * (s->t[i] - best->u[i]);
      ok = plan->value <= best->value + descent + SHARE * s->reach + slack;
      rise = (plan->value - best->value - descent) / (SHARE * s->reach);
    }
  }
  if (ok) {
    s->envelope = plan->value + plain_step(s, plan, lower, upper, &s->reach) + s->reach;
    for (i = 0; i < N * NS; ++i) s->planned[i] = plan->x[i];
    s->tau = untried ? s->resume : 1;
    return 1;
  }
  if (!untried && !bold) {
    /* The quadratic that the cost followed along T - U says which gamma would have been short enough. */
    s->gamma *= rise > 2 ? larger(1 / rise, DRAWN_IN) : 0.5;
    s->envelope = best->value + plain_step(s, best, lower, upper, &s->reach) + s->reach;
  }
  s->tau = untried ? SHORTEST * SHORTER : SHORTER * s->tau;
  return 0;
}

/* L D L' on the free rows; what is not free is a unit row. Pivots that are not positive are replaced. */
INLINE void factorise(In matrix, const int* free, Out lower, Out pivots) {
  int i, j, k;
  for (j = 0; j < NU; ++j) {
    casadi_real size = fabs(matrix[j * NU + j]) + TINY, pivot = matrix[j * NU + j];
    for (k = 0; k < j; ++k) pivot -= lower[k * NU + j] * lower[k * NU + j] * pivots[k];
    if (!free[j]) pivot = 1;
    pivots[j] = pivot > PIVOT * size ? pivot : size;
    for (i = j + 1; i < NU; ++i) {
      casadi_real sum = matrix[j * NU + i];
      for (k = 0; k < j; ++k) sum -= lower[k * NU + i] * lower[k * NU + j] * pivots[k];
      lower[j * NU + i] = free[i] && free[j] ? sum / pivots[j] : 0;
    }
  }
}

INLINE void substitute(const int* free, In lower, In pivots, Out column) {
  int i, k;
  for (i = 0; i < NU; ++i) {
    if (!free[i]) column[i] = 0;
    for (k = 0; k < i; ++k) column[i] -= lower[k * NU + i] * column[k];
  }
  for (i = 0; i < NU; ++i) column[i] /= pivots[i];
  for (i = NU - 1; i >= 0; --i)
    for (k = i + 1; k < NU; ++k) column[i] -= lower[i * NU + k] * column[k];
}

/* The stage's box QP; returns in v the best move, and in free, lower, pivots the factors of the feedback. */
INLINE void box_policy(In slope, In matrix, In low, In high, Out v, int* free, Out lower, Out pivots) {
  int i, j, round, same, held[NU];
  casadi_real move[NU], lowest = 0;
  for (i = 0; i < NU; ++i) move[i] = v[i] = 0;
  for (round = 0; round <= ROUNDS; ++round) {
    In at = round < ROUNDS ? move : v; /* the last round only finds what is free at the best move */
    for (i = 0; i < NU; ++i) {
      casadi_real rate = slope[i];
      for (j = 0; j < NU; ++j) rate += matrix[j * NU + i] * at[j];
      held[i] = (at[i] <= low[i] && rate > 0) || (at[i] >= high[i] && rate < 0);
    }
    for (same = round > 0, i = 0; same && i < NU; ++i) same = free[i] == !held[i];
    for (i = 0; i < NU; ++i) free[i] = !held[i];
    if (!same) factorise(matrix, free, lower, pivots);
    if (round == ROUNDS) return;
    if (same) continue; /* the same system has the same solution */
    {
      casadi_real target[NU], value = 0;
      for (i = 0; i < NU; ++i) {
        target[i] = -slope[i];
        for (j = 0; j < NU; ++j) target[i] -= free[j] ? 0 : matrix[j * NU + i] * move[j];
      }
      substitute(free, lower, pivots, target);
      for (i = 0; i < NU; ++i) move[i] = between(free[i] ? target[i] : move[i], low[i], high[i]);
      for (i = 0; i < NU; ++i) {
        casadi_real half = 0;
        for (j = 0; j < NU; ++j) half += matrix[j * NU + i] * move[j];
        value += (slope[i] + 0.5 * half) * move[i];
      }
      if (value < lowest) {
        lowest = value;
        for (i = 0; i < NU; ++i) v[i] = move[i];
      }
    }
  }
}

/* One Riccati sweep around the accepted plan: feedforward v, deformed, and feedback K. */
INLINE int direct(Search* s, const Plan* plan, In data, In lower, In upper) {
  int i, j, l, m;
  In arg[8];
  Out res[8];
  casadi_real p[NS * NS], lean[NS], wanted[N * NU];
  for (j = 0; j < NS * NS; ++j) p[j] = s->final[j];
  for (j = 0; j < NS; ++j) lean[j] = s->lambda[N * NS + j];
  for (i = N - 1; i >= 0; --i) {
    casadi_real a[NS * NS], b[NS * NU], ls[NS], lu[NU];
    casadi_real q[NS * NS], cross[NU * NS], r[NU * NU], turned[NS * NS], flat[NU * NS];
    casadi_real steep[NU], low[NU], high[NU], factor[NU * NU], pivots[NU], *v = wanted + i * NU, *k = s->k + i * NU * NS;
    casadi_real next[NS], pull[NU], gap[NU];
    int free[NU];
    arg[0] = s->partials + i * NM;
    res[0] = a, res[1] = b, res[2] = ls, res[3] = lu;
    if (linearise(arg, res, 0, 0, 0)) return 1;
    arg[0] = plan->x + i * NS, arg[1] = plan->u + i * NU, arg[2] = data + i * NT, arg[3] = s->lambda + (i + 1) * NS;
    res[0] = q, res[1] = cross, res[2] = r;
    if (hessian(arg, res, 0, 0, 0)) return 1;
    condense(q, cross, r, p, a, b, turned);
    for (l = 0; l < NU; ++l) {
      r[l * NU + l] += DAMPING / scale[l];
      steep[l] = lu[l];
      for (j = 0; j < NS; ++j) steep[l] += b[l * NS + j] * lean[j];
      low[l] = lower[l] - plan->u[i * NU + l];
      high[l] = upper[l] - plan->u[i * NU + l];
    }
    box_policy(steep, r, low, high, v, free, factor, pivots);
    for (j = 0; j < NS; ++j) {
      for (l = 0; l < NU; ++l) k[j * NU + l] = -cross[j * NU + l];
      substitute(free, factor, pivots, k + j * NU);
    }
    for (l = 0; l < NU; ++l) {
      gap[l] = steep[l];
      for (m = 0; m < NU; ++m) gap[l] += r[m * NU + l] * v[m];
      pull[l] = v[l];
    }
    for (j = 0; j < NS; ++j) next[j] = ls[j];
    for (m = 0; m < NS; ++m)
      for (j = 0; j < NS; ++j) next[j] += turned[m * NS + j] * lean[m];
    for (j = 0; j < NS; ++j)
      for (l = 0; l < NU; ++l) next[j] += cross[j * NU + l] * pull[l] + k[j * NU + l] * gap[l];
    for (j = 0; j < NS; ++j) lean[j] = next[j];
    /* P = Q + A'PA + Q_us'K, made symmetric */
    transpose(flat, cross, NU, NS);
    multiply(q, flat, k, NS, NU, NS);
    for (j = 0; j < NS; ++j)
      for (m = 0; m < NS; ++m) p[j * NS + m] = 0.5 * (q[j * NS + m] + q[m * NS + j]);
  }
  arg[0] = wanted, arg[1] = data, res[0] = s->v;
  return deformed(arg, res, 0, 0, 0);
}

/* max |U - clip(U - D g)| */
INLINE casadi_real residual(const Search* s, const Plan* plan, In lower, In upper) {
  int k;
  casadi_real worst = 0;
  (void)s; /* needed where settings are live */
  for (k = 0; k < N * NU; ++k) {
    casadi_real moved = between(plan->u[k] - scale[k % NU] * plan->g[k], lower[k % NU], upper[k % NU]);
    casadi_real move = fabs(plan->u[k] - moved);
    worst = move > worst ? move : worst;
  }
  return worst;
}

INLINE void begin(Search* s, Plan* best, In memory, In lower, In upper) {
  int i, l, known = all_finite(memory, MEMORY);
  casadi_real gamma = known ? memory[MEMORY - 2] : 0, tau = known ? memory[MEMORY - 1] : 0;
  for (i = 0; i < N; ++i)
    for (l = 0; l < NU; ++l) {
      best->u[i * NU + l] = between(known ? memory[i * NU + l] : 0, lower[l], upper[l]);
      s->v[i * NU + l] = best->g[i * NU + l] = 0;
      s->t[i * NU + l] = between(0, lower[l], upper[l]);
    }
  for (i = 0; i < N * NS; ++i) s->planned[i] = known ? memory[N * NU + i] : 0;
  for (i = 0; i < N * NU * NS; ++i) s->k[i] = known ? memory[N * (NU + NS) + i] : 0;
  best->value = s->envelope = 10 * UNTRIED;
  s->reach = 0;
  s->tau = 1;
  s->resume = tau > 0 ? smaller(tau, 1) : 1;
  /* After a rejected T a longer gamma would be rejected again, in every call of one iteration. */
  s->gamma = gamma > 0 ? smaller((s->resume < SHORTEST ? 1 : 2) * gamma, FIRST_GAMMA) : FIRST_GAMMA;
}

INLINE void remember(const Search* s, const Plan* best, Out memory) {
  int i;
  for (i = 0; i < N * NU; ++i) memory[i] = best->u[i];
  for (i = 0; i < N * NS; ++i) memory[N * NU + i] = s->planned[i];
  for (i = 0; i < N * NU * NS; ++i) memory[N * (NU + NS) + i] = s->k[i];
  memory[MEMORY - 2] = s->gamma;
  memory[MEMORY - 1] = s->tau;
}

/* The new memory may lie where the old one lies, which is read as a whole before. */
INLINE int run(const casadi_real** arg, casadi_real** res, casadi_real* w) {
  static const casadi_real nothing[(N + 1) * NT + MEMORY + NS + NU]; /* CasADi passes no address for zeros */
  In s0 = arg[0] ? arg[0] : nothing, data = arg[1] ? arg[1] : nothing, memory = arg[4] ? arg[4] : nothing;
  In lower = arg[2] ? arg[2] : nothing, upper = arg[3] ? arg[3] : nothing;
  Search* restrict s = (Search*)w;
  Plan *best = s->plans, *plan = s->plans + 1, *other;
  int i, posed = sane(s0, data, lower, upper), count = 0, plain = 0, empty = 0, evaluated, status;
  casadi_real left = 0;
#ifdef SCALE_AT
  for (i = 0; i < NU; ++i) s->metric[i] = data[SCALE_AT + i];
  s->first_gamma = SHARE / data[STEEPEST_AT];
#endif
  begin(s, best, memory, lower, upper);
  for (;; ++count) {
    int bold = s->tau >= SHORTEST;
    int ok = try_next(s, best, plan, s0, data, lower, upper), accepted = judged(s, best, plan, ok, lower, upper);
    plain += !bold;
    if (accepted) other = best, best = plan, plan = other;
    if (count == ITERATIONS || (STOP_EARLY && plain == PLAIN)) break;
    if (STOP_EARLY && best->value < UNTRIED && residual(s, best, lower, upper) <= TOLERANCE) break;
    if (accepted && direct(s, best, data, lower, upper)) return 1;
  }
  evaluated = best->value < UNTRIED;
  left = residual(s, best, lower, upper);
  for (i = 0; i < NU; ++i) empty |= lower[i] > upper[i];
  status = empty ? INFEASIBLE : !(posed && evaluated) ? NON_FINITE : left <= TOLERANCE ? CONVERGED : NOT_CONVERGED;
  if (res[0]) for (i = 0; i < N * NU; ++i) res[0][i] = best->u[i];
  if (res[1]) {
    res[1][0] = posed && evaluated ? best->value : 0;
    res[1][1] = posed && evaluated ? left : 0;
    res[1][2] = 0;
    res[1][3] = count;
    res[1][4] = status;
  }
  if (res[2]) {
    if (posed && evaluated) remember(s, best, res[2]);
    else for (i = 0; i < MEMORY; ++i) res[2][i] = !posed ? memory[i] : i < N * NU ? middle(lower[i % NU], upper[i % NU]) : 0;
  }
  return 0;
}
