/* The iteration of FixedPoint as loops around generated stage functions.

   The same mathematics as the composed graph in fixed_point.py and search.py, which is the reference it is tested against:
   names follow those files. What is generated stands before this text: the stage functions evaluate, pull, linearise, hessian, end
   and deformed, the sizes NS, NU, NT (entries of the data of a stage), NM (partial derivatives of a stage), N, the constants of the search, and ENTRY, the name of the function. Matrices are column-major, stages follow each other. Nothing is allocated: what is as long as a
   plan lies in the caller's work, ROOM numbers. The words of truths (ANY, EITHER, ...) stand before too: a number may be a row of numbers
   of loops side by side, of which each decides for itself. */

typedef struct {
  casadi_real u[N * NU], x[(N + 1) * NS], g[N * NU], value;
} Plan;

typedef struct {
  Plan plans[2];
  casadi_real v[N * NU];
  casadi_real partials[N * NM], lambda[COSTATES * NS], final[NS * NS];
  casadi_real envelope, reach, tau, gamma, resume;
#ifdef SCALE_AT
  casadi_real metric[NU], first_gamma; /* settings are live: the scale and the first gamma are data of the call */
#endif
} Search;

#define GAINS (N * (NU + NS)) /* where they begin in the memory */

/* The costate of a node: that of the end stays, and of the others all or the last two. */
#define COSTATE(i) (s->lambda + NS * (COSTATES > N ? (i) : (i) == N ? 2 : (i) & 1))

typedef char search_fits[sizeof(Search) == ROOM * sizeof(casadi_real) ? 1 : -1];

#ifdef SCALE_AT
#define scale (s->metric)
#define FIRST_GAMMA (s->first_gamma)
#else
TABLE Number scale[NU] = SCALE;
#endif

/* The middle of the limits of an input; 0 without one of them. */
INLINE casadi_real middle(casadi_real low, casadi_real high) {
  return EITHER((fabs(low) <= FINITE) & (fabs(high) <= FINITE), 0.5 * (low + high), ALL(0));
}

/* Entry k of U - gamma D g, which the limits clip. */
INLINE casadi_real descended(const Search* s, const Plan* plan, int k) {
  return plan->u[k] - s->gamma * scale[k % NU] * plan->g[k];
}

/* Roll out the next plan, with its cost and gradient; NO when something is not finite. The partial derivatives stay, for the
   Jacobians of a plan that is accepted. */
INLINE Truth try_next(Search* s, const Plan* best, Plan* plan, In gains, In s0, In data, In lower, In upper) {
  int i, j, l;
  Truth bold = s->tau >= SHORTEST, untried = best->value >= UNTRIED;
  In arg[8];
  Out res[8];
  casadi_real cost, slope[NS];
  plan->value = ALL(0);
  for (j = 0; j < NS; ++j) plan->x[j] = s0[j];
  for (i = 0; i < N; ++i) {
    Out u = plan->u + i * NU, x = plan->x + i * NS;
    casadi_real apart[NS];
    for (j = 0; j < NS; ++j) apart[j] = x[j] - best->x[i * NS + j];
    for (l = 0; l < NU; ++l) {
      casadi_real wanted = best->u[i * NU + l] + s->tau * s->v[i * NU + l];
      for (j = 0; j < NS; ++j) wanted += gains[(i * NS + j) * NU + l] * apart[j];
      if (!EVERY(bold)) {
        casadi_real plain = EITHER(untried, ALL(0), descended(s, best, i * NU + l));
        wanted = EITHER(bold, wanted, plain);
      }
      u[l] = between(wanted, lower[l], upper[l]);
    }
    arg[0] = x, arg[1] = u, arg[2] = data + i * NT;
    res[0] = x + NS, res[1] = &cost, res[2] = s->partials + i * NM;
    if (evaluate(arg, res, 0, 0, 0)) return NO;
    plan->value += cost;
  }
  arg[0] = plan->x + N * NS, arg[1] = data + N * NT;
  res[0] = &cost, res[1] = slope, res[2] = s->final;
  if (end(arg, res, 0, 0, 0)) return NO;
  plan->value += cost;
  for (j = 0; j < NS; ++j) COSTATE(N)[j] = slope[j];
  for (i = N - 1; i >= 0; --i) {
    arg[0] = s->partials + i * NM, arg[1] = COSTATE(i + 1), arg[2] = data + i * NT;
    res[0] = COSTATE(i), res[1] = plan->g + i * NU;
    if (pull(arg, res, 0, 0, 0)) return NO;
  }
  return all_finite(&plan->value, 1) & all_finite(plan->g, N * NU) & all_finite(plan->x, (N + 1) * NS);
}

/* The plain fixed-point step t = clip(U - gamma D g); returns g'(t - U), and in reach |t - U|^2 / (2 gamma). */
INLINE casadi_real plain_step(const Search* s, const Plan* plan, In lower, In upper, casadi_real* reach) {
  int k;
  casadi_real descent = ALL(0), size = ALL(0);
  for (k = 0; k < N * NU; ++k) {
    casadi_real move = between(descended(s, plan, k), lower[k % NU], upper[k % NU]) - plan->u[k];
    descent += plan->g[k] * move;
    size += move * move / scale[k % NU];
  }
  *reach = size / (2 * s->gamma);
  return descent;
}

/* Which search goes on from here, with the envelope of its plain step. */
INLINE void settle(Search* s, Truth here, casadi_real envelope, casadi_real reach) {
  s->envelope = EITHER(here, envelope, s->envelope);
  s->reach = EITHER(here, reach, s->reach);
}

/* Where the search goes on, accept the tried plan and return YES, or draw in and return NO. */
INLINE Truth judged(Search* s, const Plan* best, const Plan* plan, Truth ok, Truth on, In lower, In upper) {
  int i;
  Truth untried = best->value >= UNTRIED, bold = s->tau >= SHORTEST, rejected, drawn;
  casadi_real slack = ROUNDING * (1 + fabs(best->value)), reach = ALL(0), envelope = ALL(0), rise = ALL(0), step;
  if (ANY(ok)) {
    step = plain_step(s, plan, lower, upper, &reach);
    envelope = plan->value + step + reach;
  }
  if (ANY(ok & NOT(untried))) {
    casadi_real descent = ALL(0);
    Truth freely, plainly;
    for (i = 0; i < N * NU; ++i) descent += best->g[i] * (plan->u[i] - best->u[i]);
    freely = (envelope <= s->envelope - SHARE * (1 - SHARE) * s->reach + slack) |
             (plan->value <= best->value + ARMIJO * smaller(descent, ALL(0)) + slack);
    freely &= (envelope <= s->envelope + slack) & (plan->value <= best->value + slack);
    plainly = plan->value <= best->value + descent + SHARE * s->reach + slack;
    rise = EITHER(ok, (plan->value - best->value - descent) / (SHARE * s->reach), ALL(0));
    ok &= untried | (bold & freely) | (NOT(bold) & plainly);
  }
  rejected = on & NOT(ok);
  drawn = rejected & NOT(untried) & NOT(bold);
  ok &= on;
  if (ANY(ok)) {
    settle(s, ok, envelope, reach);
    s->tau = EITHER(ok, EITHER(untried, s->resume, ALL(1)), s->tau);
  }
  if (ANY(drawn)) {
    /* The quadratic that the cost followed along T - U says which gamma would have been short enough. */
    s->gamma *= EITHER(drawn, EITHER(rise > 2, larger(1 / rise, ALL(DRAWN_IN)), ALL(0.5)), ALL(1));
    step = plain_step(s, best, lower, upper, &reach);
    settle(s, drawn, best->value + step + reach, reach);
  }
  s->tau = EITHER(rejected, EITHER(untried, ALL(SHORTEST * SHORTER), SHORTER * s->tau), s->tau);
  return ok;
}

/* The accepted plan is the best one. */
INLINE void exchange(Plan** best, Plan** plan, Truth accepted) {
  Plan* other = *best;
  if (EVERY(accepted)) {
    *best = *plan, *plan = other;
  } else if (ANY(accepted)) {
    Out to = (Out)other;
    In from = (In)*plan;
    int i;
    for (i = 0; i < (int)(sizeof(Plan) / sizeof(casadi_real)); ++i) to[i] = EITHER(accepted, from[i], to[i]);
  }
}

/* L D L' on the free rows; what is not free is no part of the others. Pivots that are not positive are replaced. */
INLINE void factorise(In matrix, const Truth* free, Out lower, Out pivots) {
  int i, j, k;
  for (j = 0; j < NU; ++j) {
    casadi_real size = fabs(matrix[j * NU + j]) + TINY, pivot = matrix[j * NU + j];
    for (k = 0; k < j; ++k) pivot -= lower[k * NU + j] * lower[k * NU + j] * pivots[k];
    pivots[j] = EITHER(pivot > PIVOT * size, pivot, size);
    for (i = j + 1; i < NU; ++i) {
      casadi_real sum = matrix[j * NU + i];
      for (k = 0; k < j; ++k) sum -= lower[k * NU + i] * lower[k * NU + j] * pivots[k];
      lower[j * NU + i] = EITHER(free[i] & free[j], sum / pivots[j], ALL(0));
    }
  }
}

INLINE void substitute(const Truth* free, In lower, In pivots, Out column) {
  int i, k;
  for (i = 0; i < NU; ++i) {
    column[i] = EITHER(free[i], column[i], ALL(0));
    for (k = 0; k < i; ++k) column[i] -= lower[k * NU + i] * column[k];
  }
  for (i = 0; i < NU; ++i) column[i] /= pivots[i];
  for (i = NU - 1; i >= 0; --i)
    for (k = i + 1; k < NU; ++k) column[i] -= lower[i * NU + k] * column[k];
}

/* The stage's box QP; returns in v the best move, and in free, lower, pivots the factors of the feedback. */
INLINE void box_policy(In slope, In matrix, In low, In high, Out v, Truth* free, Out lower, Out pivots) {
  int i, j, round;
  Truth same, held[NU];
  casadi_real move[NU], lowest = ALL(0);
  for (i = 0; i < NU; ++i) move[i] = v[i] = ALL(0);
  for (round = 0; round <= ROUNDS; ++round) {
    In at = round < ROUNDS ? move : v; /* the last round only finds what is free at the best move */
    for (i = 0; i < NU; ++i) {
      casadi_real rate = slope[i];
      for (j = 0; j < NU; ++j) rate += matrix[j * NU + i] * at[j];
      held[i] = ((at[i] <= low[i]) & (rate > 0)) | ((at[i] >= high[i]) & (rate < 0));
    }
    same = round > 0 ? YES : NO;
    for (i = 0; round > 0 && i < NU; ++i) same &= NOT(free[i] ^ NOT(held[i]));
    for (i = 0; i < NU; ++i) free[i] = NOT(held[i]);
    if (!EVERY(same)) factorise(matrix, free, lower, pivots);
    if (round == ROUNDS) return;
    if (EVERY(same)) { /* the same system has the same solution, in every further round */
      round = ROUNDS - 1;
      continue;
    }
    {
      casadi_real target[NU], value = ALL(0);
      for (i = 0; i < NU; ++i) {
        target[i] = -slope[i];
        for (j = 0; j < NU; ++j) target[i] -= EITHER(free[j], ALL(0), matrix[j * NU + i] * move[j]);
      }
      substitute(free, lower, pivots, target);
      for (i = 0; i < NU; ++i) move[i] = between(EITHER(free[i], target[i], move[i]), low[i], high[i]);
      for (i = 0; i < NU; ++i) {
        casadi_real halved = ALL(0);
        for (j = 0; j < NU; ++j) halved += matrix[j * NU + i] * move[j];
        value += (slope[i] + 0.5 * halved) * move[i];
      }
      if (ANY(value < lowest)) {
        for (i = 0; i < NU; ++i) v[i] = EITHER(value < lowest, move[i], v[i]);
        lowest = EITHER(value < lowest, value, lowest);
      }
    }
  }
}

/* One Riccati sweep around the accepted plan: feedforward v, deformed, and feedback K. */
INLINE int direct(Search* s, const Plan* plan, Out gains, Truth accepted, In data, In lower, In upper) {
  int i, j, l, m;
  In arg[8];
  Out res[8];
  casadi_real p[NS * NS], lean[NS], wanted[N * NU], moved[N * NU];
  for (j = 0; j < NS * NS; ++j) p[j] = s->final[j];
  for (j = 0; j < NS; ++j) lean[j] = COSTATE(N)[j];
  for (i = N - 1; i >= 0; --i) {
    casadi_real a[NS * NS], b[NS * NU], ls[NS], lu[NU];
    casadi_real q[NS * NS], cross[NU * NS], r[NU * NU], turned[NS * NS], flat[NU * NS];
    casadi_real steep[NU], low[NU], high[NU], factor[NU * NU], pivots[NU], *v = wanted + i * NU, k[NU * NS];
    casadi_real next[NS], pull[NU], gap[NU];
    Truth free[NU];
    arg[0] = s->partials + i * NM, arg[1] = data + i * NT;
    res[0] = a, res[1] = b, res[2] = ls, res[3] = lu;
    if (linearise(arg, res, 0, 0, 0)) return 1;
    arg[0] = plan->x + i * NS, arg[1] = plan->u + i * NU, arg[2] = data + i * NT, arg[3] = COSTATE(i + 1);
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
      for (l = 0; l < NU; ++l) {
        Out one = gains + (i * NS + j) * NU + l;
        *one = EITHER(accepted, k[j * NU + l], *one);
      }
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
  arg[0] = wanted, arg[1] = data, res[0] = moved;
  if (deformed(arg, res, 0, 0, 0)) return 1;
  for (i = 0; i < N * NU; ++i) s->v[i] = EITHER(accepted, moved[i], s->v[i]);
  return 0;
}

/* max |U - clip(U - D g)| */
INLINE casadi_real residual(const Search* s, const Plan* plan, In lower, In upper) {
  int k;
  casadi_real worst = ALL(0);
  (void)s; /* needed where settings are live */
  for (k = 0; k < N * NU; ++k) {
    casadi_real moved = between(plan->u[k] - scale[k % NU] * plan->g[k], lower[k % NU], upper[k % NU]);
    casadi_real move = fabs(plan->u[k] - moved);
    worst = EITHER(move > worst, move, worst);
  }
  return worst;
}

INLINE void begin(Search* s, Plan* best, Out gains, In memory, Truth posed, In lower, In upper) {
  int i, l;
  Truth known = all_finite(memory, MEMORY);
  casadi_real gamma = EITHER(known, memory[MEMORY - 2], ALL(0)), tau = EITHER(known, memory[MEMORY - 1], ALL(0));
  for (i = 0; i < N; ++i)
    for (l = 0; l < NU; ++l) {
      best->u[i * NU + l] = between(EITHER(known, memory[i * NU + l], ALL(0)), lower[l], upper[l]);
      s->v[i * NU + l] = best->g[i * NU + l] = ALL(0);
    }
  for (i = 0; i < N * NS; ++i) best->x[i] = EITHER(known, memory[N * NU + i], ALL(0));
  for (i = 0; i < N * NU * NS; ++i) gains[i] = EITHER(known | NOT(posed), memory[GAINS + i], ALL(0));
  best->value = s->envelope = ALL(10 * UNTRIED);
  s->reach = ALL(0);
  s->tau = ALL(1);
  s->resume = EITHER(tau > 0, smaller(tau, ALL(1)), ALL(1));
  /* After a rejected T a longer gamma would be rejected again, in every call of one iteration. */
  s->gamma = smaller(EITHER(s->resume < SHORTEST, ALL(1), ALL(2)) * gamma, ALL(FIRST_GAMMA));
  s->gamma = EITHER(gamma > 0, s->gamma, ALL(FIRST_GAMMA));
}

/* The memory of a solved call; else that of a plan amid the limits, and the old one where nothing was posed. The gains are there. */
INLINE void remember(const Search* s, const Plan* best, Truth good, Truth posed, In old, In lower, In upper, Out to) {
  int i;
#define FRESH(k, value) EITHER(posed, value, old[k])
  for (i = 0; i < N * NU; ++i) to[i] = EITHER(good, best->u[i], FRESH(i, middle(lower[i % NU], upper[i % NU])));
  for (i = 0; i < N * NS; ++i) to[N * NU + i] = EITHER(good, best->x[i], FRESH(N * NU + i, ALL(0)));
  for (i = 0; i < N * NU * NS; ++i) to[GAINS + i] = EITHER(good | NOT(posed), to[GAINS + i], ALL(0));
  to[MEMORY - 2] = EITHER(good, s->gamma, FRESH(MEMORY - 2, ALL(0)));
  to[MEMORY - 1] = EITHER(good, s->tau, FRESH(MEMORY - 1, ALL(0)));
}

/* The new memory may lie where the old one lies. Its gains serve as those of the search, and stay the old ones where nothing is
   posed; the rest is read before it is written. */
INLINE int run(const casadi_real** arg, casadi_real** res, casadi_real* w) {
#ifdef __OPENCL_VERSION__
#define GIVEN(k) arg[k]
#else
  static const casadi_real nothing[(N + 1) * NT + MEMORY + NS + NU]; /* CasADi passes no address for zeros */
#define GIVEN(k) (arg[k] ? arg[k] : nothing)
#endif
  In s0 = GIVEN(0), data = GIVEN(1), lower = GIVEN(2), upper = GIVEN(3), memory = GIVEN(4);
  Search* restrict s = (Search*)w;
  Plan *best = s->plans, *plan = s->plans + 1;
  int i, tried;
  Truth posed = sane(s0, data, lower, upper), on = YES, empty = NO, good;
  Out gains = res[2] + GAINS;
  casadi_real left, count = ALL(0), plain = ALL(0);
#ifdef SCALE_AT
  for (i = 0; i < NU; ++i) s->metric[i] = data[SCALE_AT + i];
  s->first_gamma = SHARE / data[STEEPEST_AT];
#endif
  begin(s, best, gains, memory, posed, lower, upper);
  for (tried = 0;; ++tried) {
    Truth bold = s->tau >= SHORTEST, ok = try_next(s, best, plan, gains, s0, data, lower, upper);
    Truth accepted = judged(s, best, plan, ok & posed, on, lower, upper);
    exchange(&best, &plan, accepted);
    if (tried == ITERATIONS) break;
    if (STOP_EARLY) {
      plain += EITHER(bold, ALL(0), ALL(1));
      on &= plain < PLAIN;
      on &= NOT((best->value < UNTRIED) & (residual(s, best, lower, upper) <= TOLERANCE));
      if (!ANY(on)) break;
      accepted &= on;
    }
    count += EITHER(on, ALL(1), ALL(0));
    if (ANY(accepted) && direct(s, best, gains, accepted, data, lower, upper)) return 1;
  }
  good = posed & (best->value < UNTRIED);
  left = residual(s, best, lower, upper);
  for (i = 0; i < NU; ++i) empty |= lower[i] > upper[i];
  if (res[0]) for (i = 0; i < N * NU; ++i) res[0][i] = best->u[i];
  if (res[1]) {
    res[1][0] = EITHER(good, best->value, ALL(0));
    res[1][1] = EITHER(good, left, ALL(0));
    res[1][2] = ALL(0);
    res[1][3] = count;
    res[1][4] = EITHER(good, EITHER(left <= TOLERANCE, ALL(CONVERGED), ALL(NOT_CONVERGED)), ALL(NON_FINITE));
    res[1][4] = EITHER(empty, ALL(INFEASIBLE), res[1][4]);
  }
  if (EVERY(good)) remember(s, best, YES, posed, memory, lower, upper, res[2]);
  else remember(s, best, good, posed, memory, lower, upper, res[2]);
  return 0;
}
