/* The iteration of FixedPointSolver as loops around generated stage functions.

   The same mathematics as the composed graph in plain.py and search.py, which is the reference it is tested against:
   names follow those files. What is generated stands before this text: the stage functions evaluate, pull, linearise, hessian, end
   and deformed, the sizes NS, NU, NT (entries of the data of a stage), NM (partial derivatives of a stage), N, the constants of the search, and ENTRY, the name of the function. Matrices are column-major, stages follow each other. Nothing is allocated: what is as long as a
   plan lies in the caller's work, ROOM numbers. */

typedef struct {
  casadi_real u[N * NU], x[(N + 1) * NS], g[N * NU], value;
} Plan;

typedef struct {
  Plan plans[2];
  casadi_real v[N * NU], curved[N * NU * NU]; /* the next step, and Q_uu of the last sweep */
  casadi_real partials[N * NM], lambda[COSTATES * NS], final[NS * NS];
  casadi_real envelope, reach, tau, gamma, resume;
  casadi_real sent; /* the largest move that a sweep at the best plan wants of an input; beyond every number before one */
} Search;

#define GAINS (N * (NU + NS)) /* where they begin in the memory */

/* The costate of a node: that of the end stays, and of the others all or the last two. */
#define COSTATE(i) (s->lambda + NS * (COSTATES > N ? (i) : (i) == N ? 2 : (i) & 1))

FITS(Search, search_fits);

static const casadi_real scale[NU] = SCALE;

/* The middle of the limits of an input; 0 without one of them. */
INLINE casadi_real middle(casadi_real low, casadi_real high) {
  return ((fabs(low) <= FINITE) & (fabs(high) <= FINITE)) ? 0.5 * (low + high) : 0;
}

/* Entry k of U - gamma D g, which the limits clip. */
INLINE casadi_real descended(const Search* s, const Plan* plan, int k) {
  return plan->u[k] - s->gamma * scale[k % NU] * plan->g[k];
}

/* Roll out the next plan, with its cost and gradient; 0 when something is not finite. The partial derivatives stay, for the
   Jacobians of a plan that is accepted. */
INLINE int try_next(Search* s, const Plan* best, Plan* plan, In gains, In s0, In data, In lower, In upper) {
  int i, j, l;
  int bold = s->tau >= SHORTEST, untried = best->value >= UNTRIED;
  SLOTS;
  casadi_real cost, slope[NS];
  plan->value = 0;
  for (j = 0; j < NS; ++j) plan->x[j] = s0[j];
  for (i = 0; i < N; ++i) {
    Out u = plan->u + i * NU, x = plan->x + i * NS;
    casadi_real apart[NS];
    for (j = 0; j < NS; ++j) apart[j] = x[j] - best->x[i * NS + j];
    for (l = 0; l < NU; ++l) {
      casadi_real wanted = best->u[i * NU + l] + s->tau * s->v[i * NU + l];
      for (j = 0; j < NS; ++j) wanted += gains[(i * NS + j) * NU + l] * apart[j];
      if (!bold) wanted = untried ? 0 : descended(s, best, i * NU + l);
      u[l] = between(wanted, lower[l], upper[l]);
    }
    arg[0] = x, arg[1] = u, arg[2] = data + i * NT;
    res[0] = x + NS, res[1] = &cost, res[2] = s->partials + i * NM;
    NEEDED(evaluate);
    plan->value += cost;
  }
  arg[0] = plan->x + N * NS, arg[1] = data + N * NT;
  res[0] = &cost, res[1] = slope, res[2] = s->final;
  NEEDED(end);
  plan->value += cost;
  for (j = 0; j < NS; ++j) COSTATE(N)[j] = slope[j];
  for (i = N - 1; i >= 0; --i) {
    arg[0] = s->partials + i * NM, arg[1] = COSTATE(i + 1);
    res[0] = COSTATE(i), res[1] = plan->g + i * NU;
    NEEDED(pull);
  }
  return IS_FINITE(plan);
}

/* The plain fixed-point step t = clip(U - gamma D g); returns g'(t - U), and in reach |t - U|^2 / (2 gamma). */
INLINE casadi_real plain_step(const Search* s, const Plan* plan, In lower, In upper, casadi_real* reach) {
  int k;
  casadi_real descent = 0, size = 0;
  for (k = 0; k < N * NU; ++k) {
    casadi_real move = between(descended(s, plan, k), lower[k % NU], upper[k % NU]) - plan->u[k];
    descent += plan->g[k] * move;
    size += move * move / scale[k % NU];
  }
  *reach = size / (2 * s->gamma);
  return descent;
}

/* Accept the tried plan and return 1, or draw in and return 0. */
INLINE int judged(Search* s, const Plan* best, const Plan* plan, int ok, In lower, In upper) {
  int i, untried = best->value >= UNTRIED, bold = s->tau >= SHORTEST;
  casadi_real slack = ROUNDING * (1 + fabs(best->value)), rise = 0, reach, step = plain_step(s, plan, lower, upper, &reach);
  casadi_real envelope = plan->value + step + reach;
  if (ok && !untried) {
    casadi_real descent = 0;
    int freely, plainly;
    for (i = 0; i < N * NU; ++i) descent += best->g[i] * (plan->u[i] - best->u[i]);
    freely = (envelope <= s->envelope - SHARE * (1 - SHARE) * s->reach + slack) |
             (plan->value <= best->value + ARMIJO * smaller(descent, 0) + slack);
    freely &= (envelope <= s->envelope + slack) & (plan->value <= best->value + slack);
    plainly = plan->value <= best->value + descent + SHARE * s->reach + slack;
    rise = (plan->value - best->value - descent) / (SHARE * s->reach);
    ok = bold ? freely : plainly;
  }
  if (ok) {
    s->envelope = envelope, s->reach = reach;
    s->tau = untried ? s->resume : 1;
    s->sent = BEYOND;
    return 1;
  }
  if (!untried && !bold) {
    /* The quadratic that the cost followed along T - U says which gamma would have been short enough. */
    s->gamma *= rise > 2 ? larger(1 / rise, DRAWN_IN) : 0.5;
    step = plain_step(s, best, lower, upper, &reach);
    s->envelope = best->value + step + reach, s->reach = reach;
  }
  s->tau = untried ? SHORTEST * SHORTER : SHORTER * s->tau;
  return 0;
}

/* L D L' on the free rows; what is not free is no part of the others. Pivots that are not positive are replaced. */
INLINE void factorise(In matrix, const int* free, Out lower, Out pivots) {
  int i, j, k;
  for (j = 0; j < NU; ++j) {
    casadi_real size = fabs(matrix[j * NU + j]) + TINY, pivot = matrix[j * NU + j];
    for (k = 0; k < j; ++k) pivot -= lower[k * NU + j] * lower[k * NU + j] * pivots[k];
    pivots[j] = pivot > PIVOT * size ? pivot : size;
    for (i = j + 1; i < NU; ++i) {
      casadi_real sum = matrix[j * NU + i];
      for (k = 0; k < j; ++k) sum -= lower[k * NU + i] * lower[k * NU + j] * pivots[k];
      lower[j * NU + i] = (free[i] & free[j]) ? sum / pivots[j] : 0;
    }
  }
}

INLINE void substitute(const int* free, In lower, In pivots, Out column) {
  int i, k;
  for (i = 0; i < NU; ++i) {
    column[i] = free[i] ? column[i] : 0;
    for (k = 0; k < i; ++k) column[i] -= lower[k * NU + i] * column[k];
  }
  for (i = 0; i < NU; ++i) column[i] /= pivots[i];
  for (i = NU - 1; i-- > 0;)
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
      held[i] = ((at[i] <= low[i]) & (rate > 0)) | ((at[i] >= high[i]) & (rate < 0));
    }
    same = round > 0;
    for (i = 0; round > 0 && i < NU; ++i) same &= free[i] == !held[i];
    for (i = 0; i < NU; ++i) free[i] = !held[i];
    if (!same) factorise(matrix, free, lower, pivots);
    if (round == ROUNDS) return;
    if (same) { /* the same system has the same solution, in every further round */
      round = ROUNDS - 1;
      continue;
    }
    {
      casadi_real target[NU], value = 0;
      for (i = 0; i < NU; ++i) {
        target[i] = -slope[i];
        for (j = 0; j < NU; ++j) target[i] -= free[j] ? 0 : matrix[j * NU + i] * move[j];
      }
      substitute(free, lower, pivots, target);
      for (i = 0; i < NU; ++i) move[i] = between(free[i] ? target[i] : move[i], low[i], high[i]);
      for (i = 0; i < NU; ++i) {
        casadi_real halved = 0;
        for (j = 0; j < NU; ++j) halved += matrix[j * NU + i] * move[j];
        value += (slope[i] + 0.5 * halved) * move[i];
      }
      if (value < lowest) {
        for (i = 0; i < NU; ++i) v[i] = move[i];
        lowest = value;
      }
    }
  }
}

/* Note what a sweep at the plan wants. Where the cost is flat a move is no error: it lowers the cost by nothing. */
INLINE void want(Search* s, const Plan* plan, casadi_real most, casadi_real fall) {
  casadi_real flat = FLAT * fabs(plan->value);
  s->sent = fall > flat ? most : fall <= flat ? 0 : BEYOND; /* what is no number is no certificate */
}

/* What a sweep at an accepted plan would want, by one adjoint pass with the factors of the last sweep. */
INLINE int look(Search* s, const Plan* plan, In gains, In lower, In upper) {
  int i, j, l;
  SLOTS;
  casadi_real ahead[NS], fall = 0, most = 0;
  for (j = 0; j < NS; ++j) ahead[j] = COSTATE(N)[j];
  for (i = N - 1; i >= 0; --i) {
    casadi_real next[NS], steep[NU], low[NU], high[NU], factor[NU * NU], pivots[NU], v[NU];
    int free[NU];
    arg[0] = s->partials + i * NM, arg[1] = ahead;
    res[0] = next, res[1] = steep;
    NEEDED(pull);
    for (l = 0; l < NU; ++l) low[l] = lower[l] - plan->u[i * NU + l], high[l] = upper[l] - plan->u[i * NU + l];
    box_policy(steep, s->curved + i * NU * NU, low, high, v, free, factor, pivots);
    for (l = 0; l < NU; ++l) fall -= 0.5 * steep[l] * v[l], most = larger(most, fabs(v[l]));
    for (j = 0; j < NS; ++j)
      for (ahead[j] = next[j], l = 0; l < NU; ++l) ahead[j] += gains[(i * NS + j) * NU + l] * steep[l];
  }
  want(s, plan, most, fall);
  return 1;
}

/* One Riccati sweep around the accepted plan: feedforward v, deformed, and feedback K. */
INLINE int direct(Search* s, const Plan* plan, Out gains, In data, In lower, In upper) {
  int i, j, l, m;
  SLOTS;
  casadi_real p[NS * NS], lean[NS], wanted[N * NU], moved[N * NU], fall = 0, most = 0;
  for (j = 0; j < NS * NS; ++j) p[j] = s->final[j];
  for (j = 0; j < NS; ++j) lean[j] = COSTATE(N)[j];
  for (i = N - 1; i >= 0; --i) {
    casadi_real a[NS * NS], b[NS * NU], ls[NS], lu[NU];
    casadi_real q[NS * NS], cross[NU * NS], r[NU * NU], turned[NS * NS], flat[NU * NS];
    casadi_real steep[NU], low[NU], high[NU], factor[NU * NU], pivots[NU], *v = wanted + i * NU, k[NU * NS];
    casadi_real next[NS], pull[NU], gap[NU];
    int free[NU];
    arg[0] = s->partials + i * NM;
    res[0] = a, res[1] = b, res[2] = ls, res[3] = lu;
    NEEDED(linearise);
    arg[0] = plan->x + i * NS, arg[1] = plan->u + i * NU, arg[2] = data + i * NT, arg[3] = COSTATE(i + 1);
    res[0] = q, res[1] = cross, res[2] = r;
    NEEDED(hessian);
    condense(q, cross, r, p, a, b, turned);
    for (l = 0; l < NU; ++l) {
      r[l * NU + l] += DAMPING / scale[l];
      steep[l] = lu[l];
      for (j = 0; j < NS; ++j) steep[l] += b[l * NS + j] * lean[j];
      low[l] = lower[l] - plan->u[i * NU + l];
      high[l] = upper[l] - plan->u[i * NU + l];
    }
    box_policy(steep, r, low, high, v, free, factor, pivots);
    for (j = 0; j < NU * NU; ++j) s->curved[i * NU * NU + j] = r[j];
    for (l = 0; l < NU; ++l) fall -= 0.5 * steep[l] * v[l], most = larger(most, fabs(v[l]));
    for (j = 0; j < NS; ++j) {
      for (l = 0; l < NU; ++l) k[j * NU + l] = -cross[j * NU + l];
      substitute(free, factor, pivots, k + j * NU);
      for (l = 0; l < NU; ++l) gains[(i * NS + j) * NU + l] = k[j * NU + l];
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
  arg[0] = wanted, res[0] = moved;
  NEEDED(deformed);
  for (i = 0; i < N * NU; ++i) s->v[i] = moved[i];
  want(s, plan, most, fall);
  return 1;
}

/* max |U - clip(U - D g)| */
INLINE casadi_real residual(const Plan* plan, In lower, In upper) {
  int k;
  casadi_real worst = 0;
  for (k = 0; k < N * NU; ++k) {
    casadi_real moved = between(plan->u[k] - scale[k % NU] * plan->g[k], lower[k % NU], upper[k % NU]);
    casadi_real move = fabs(plan->u[k] - moved);
    worst = move > worst ? move : worst;
  }
  return worst;
}

INLINE void begin(Search* s, Plan* best, Out gains, In memory, int posed, In lower, In upper) {
  int i, l, known = all_finite(memory, MEMORY);
  casadi_real gamma = known ? memory[MEMORY - 2] : 0, tau = known ? memory[MEMORY - 1] : 0;
  for (i = 0; i < N; ++i)
    for (l = 0; l < NU; ++l) {
      best->u[i * NU + l] = between(known ? memory[i * NU + l] : 0, lower[l], upper[l]);
      s->v[i * NU + l] = best->g[i * NU + l] = 0;
    }
  for (i = 0; i < N * NS; ++i) best->x[i] = known ? memory[N * NU + i] : 0;
  for (i = 0; i < N * NU * NS; ++i) gains[i] = (known | !posed) ? memory[GAINS + i] : 0;
  best->value = s->envelope = BEYOND;
  s->reach = 0;
  s->sent = BEYOND;
  s->tau = 1;
  s->resume = tau > 0 ? smaller(tau, 1) : 1;
  /* After a rejected T a longer gamma would be rejected again, in every call of one iteration. */
  s->gamma = smaller((s->resume < SHORTEST ? 1 : 2) * gamma, FIRST_GAMMA);
  s->gamma = gamma > 0 ? s->gamma : FIRST_GAMMA;
}

/* The memory of a solved call; else that of a plan amid the limits, and the old one where nothing was posed. The gains are there. */
INLINE void remember(const Search* s, const Plan* best, int good, int posed, In old, In lower, In upper, Out to) {
  int i;
#define FRESH(k, value) (posed ? (value) : old[k])
  for (i = 0; i < N * NU; ++i) to[i] = good ? best->u[i] : FRESH(i, middle(lower[i % NU], upper[i % NU]));
  for (i = 0; i < N * NS; ++i) to[N * NU + i] = good ? best->x[i] : FRESH(N * NU + i, 0);
  for (i = 0; i < N * NU * NS; ++i) to[GAINS + i] = (good | !posed) ? to[GAINS + i] : 0;
  to[MEMORY - 2] = good ? s->gamma : FRESH(MEMORY - 2, 0);
  to[MEMORY - 1] = good ? s->tau : FRESH(MEMORY - 1, 0);
}

/* The gains of the new memory serve as those of the search, and stay the old ones where nothing is posed. */
static int run(const casadi_real** arg, casadi_real** res, casadi_real* w) {
  NOTHING;
  In s0 = GIVEN(0), data = GIVEN(1), lower = GIVEN(2), upper = GIVEN(3), memory = GIVEN(4);
  Search* restrict s = (Search*)w;
  Plan *best = s->plans, *plan = s->plans + 1;
  int i, tried, plain = 0, swept = 0, empty = 0, good, posed = sane(s0, data, lower, upper);
  Out gains = res[2] + GAINS;
  casadi_real left;
  begin(s, best, gains, memory, posed, lower, upper);
  for (tried = 0;; ++tried) {
    int bold = s->tau >= SHORTEST, sure = s->sent <= TOLERANCE, ok = try_next(s, best, plan, gains, s0, data, lower, upper);
    int accepted = judged(s, best, plan, ok && posed, lower, upper);
    if (accepted) {
      Plan* other = best;
      best = plan, plan = other;
    }
    if (accepted && swept && (STOP_EARLY || tried == ITERATIONS) && !look(s, best, gains, lower, upper)) return 1;
    if (tried == ITERATIONS) break;
    if (STOP_EARLY) {
      /* A small gradient alone is no certificate: at a plan where the inputs do nothing it is small too. In open loop a sweep at the
         plan before has to say so too. */
      plain += !bold;
      if (plain >= PLAIN) break;
      if ((sure || !CONVERGING) && best->value < UNTRIED && s->sent <= TOLERANCE && residual(best, lower, upper) <= TOLERANCE) break;
    }
    if (accepted && !direct(s, best, gains, data, lower, upper)) return 1;
    swept |= accepted;
  }
  good = posed && best->value < UNTRIED;
  left = residual(best, lower, upper);
  for (i = 0; i < NU; ++i) empty |= lower[i] > upper[i];
  if (res[0]) for (i = 0; i < N * NU; ++i) res[0][i] = best->u[i];
  if (res[1]) {
    res[1][0] = good ? best->value : 0;
    res[1][1] = good ? left : 0;
    res[1][2] = 0;
    res[1][3] = tried;
    res[1][4] = empty ? INFEASIBLE : !good ? NON_FINITE : left <= TOLERANCE && s->sent <= TOLERANCE ? CONVERGED : NOT_CONVERGED;
  }
  remember(s, best, good, posed, memory, lower, upper, res[2]);
  return 0;
}

int ENTRY(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
#ifdef PORTABLE /* a device wants all results */
  (void)iw, (void)mem;
  return run(arg, res, w);
#else
  casadi_real memory[MEMORY], *made[3]; /* in it lie the gains of the search */
  (void)iw, (void)mem;
  made[0] = res[0], made[1] = res[1], made[2] = res[2] ? res[2] : memory;
  return run(arg, made, w);
#endif
}
