/* Limits of a plan: their distances, and what they add to a sweep as equalities (pure) or by a barrier (interior).

   Side 0 is the lower limit, side 1 the upper one; sign (1, -1): d = sign (w - limit), and a multiplier z >= 0 adds -sign z to the
   gradient. A multiplier of a state is at most its capacity: beyond it the limit gives way. */

#define SIGN(side) (1 - 2 * (side))

typedef struct {
  casadi_real z[2][COUNT], t[2][COUNT], e[2][COUNT]; /* multipliers, slacks, and by how much a limit gives way */
} Duals;

typedef struct {
  casadi_real at[2][ROWS];
  int present[2][ROWS];
} Limits;

typedef struct {
  casadi_real gap, error, left, violation, broken; /* largest gap, scaled error, stationarity, violation, and the share of a unit that is not certified */
} Certificate;

static const casadi_real state_limits[2][NB + 1] = {STATE_LOWER, STATE_UPPER};

static const casadi_real capacities[NB + 1] = CAPACITIES, hard[NB + 1] = HARD;

INLINE casadi_real capacity(int r) { return r < NU ? 10 * FINITE : capacities[r - NU]; }
INLINE casadi_real reach(int r) { return unit[r] * unit[r] / COST; } /* gamma */
INLINE casadi_real entry(const Point* p, int i, int r) { return r < NU ? p->u[i * NU + r] : p->x[(i + 1) * NS + place[r - NU]]; }
INLINE casadi_real moved(const Direction* d, int i, int r) { return r < NU ? d->du[i * NU + r] : d->dx[(i + 1) * NS + place[r - NU]]; }
INLINE casadi_real distance(const Limits* limits, const Point* p, int side, int i, int r) {
  return SIGN(side) * (entry(p, i, r) - limits->at[side][r]);
}

/* For every limit that there is: side, stage i, row r, and k = i ROWS + r. The rows of states are the last. */
#define EACH_LIMIT_FROM(first, limits)                                             \
  for (side = 0; side < 2; ++side)                                                 \
    for (r = first; r < ROWS; ++r)                                                 \
      if ((limits)->present[side][r])                                              \
        for (i = 0, k = r; i < N; ++i, k += ROWS)
#define EACH_LIMIT(limits) EACH_LIMIT_FROM(0, limits)
#define EACH_STATE_LIMIT(limits) EACH_LIMIT_FROM(NU, limits)

static void set_limits(Limits* limits, In lower, In upper) {
  int side, r;
  for (side = 0; side < 2; ++side)
    for (r = 0; r < ROWS; ++r) {
      casadi_real at = r < NU ? (side ? upper : lower)[r] : state_limits[side][r - NU];
      limits->present[side][r] = at <= FINITE && at >= -FINITE;
      limits->at[side][r] = at;
    }
}

/* Multipliers of states as they enter the gradient, whose other rows stay; where a limit is farther than `near` of its unit they count
   as zero. */
static void pushes(Out push, const Limits* limits, const Point* p, casadi_real z[2][COUNT], casadi_real near) {
  int side, i, r, k;
  for (i = 0; i < N; ++i)
    for (r = NU; r < ROWS; ++r) push[i * ROWS + r] = 0;
  EACH_STATE_LIMIT(limits)
    if (distance(limits, p, side, i, r) <= near * unit[r]) push[k] -= SIGN(side) * between(z[side][k], 0, capacity(r));
}

/* The reduced gradient g by an adjoint sweep. */
static void adjoint(const Point* p, In push, Out g) {
  int i, j, l;
  casadi_real costate[NS], before[NS];
  for (j = 0; j < NS; ++j) costate[j] = p->tail[j];
  for (i = N; i-- > 0;) {
    for (j = 0; j < NB; ++j) costate[place[j]] += push[i * ROWS + NU + j];
    for (l = 0; l < NU; ++l) {
      casadi_real sum = p->lu[i * NU + l];
      for (j = 0; j < NS; ++j) sum += p->b[(i * NU + l) * NS + j] * costate[j];
      g[i * NU + l] = sum;
    }
    for (l = 0; l < NS; ++l) {
      casadi_real sum = p->ls[i * NS + l];
      for (j = 0; j < NS; ++j) sum += p->a[(i * NS + l) * NS + j] * costate[j];
      before[l] = sum;
    }
    for (j = 0; j < NS; ++j) costate[j] = before[j];
  }
}

static casadi_real largest_gap(const Point* p) {
  int k;
  casadi_real worst = 0;
  for (k = 0; k < N * NS; ++k) worst = larger(worst, fabs(p->f[k] - p->x[k + NS]) / spread[k % NS]);
  return worst;
}

/* How far the plan is from the first-order conditions, with these multipliers of states; g is kept for the caller. */
static Certificate certified(const Limits* limits, const Point* p, casadi_real z[2][COUNT], Out g) {
  int side, i, r, k;
  casadi_real push[COUNT];
  Certificate c = {largest_gap(p), 0, 0, 0, 0};
  c.error = c.gap;
  pushes(push, limits, p, z, 10 * FINITE);
  adjoint(p, push, g);
  for (k = 0; k < N * NU; ++k) {
    casadi_real u = p->u[k], low = limits->at[0][k % NU], high = limits->at[1][k % NU];
    c.error = larger(c.error, fabs(u - between(u - reach(k % NU) * g[k], low, high)) / unit[k % NU]);
    c.left = larger(c.left, fabs(u - between(u - g[k] / curvature[k % NU], low, high)));
  }
  EACH_STATE_LIMIT(limits) {
    casadi_real d = distance(limits, p, side, i, r), y = z[side][k];
    c.violation = larger(c.violation, -d * hard[r - NU]);
    c.error = larger(c.error, reach(r) * larger(-y, 0) / unit[r]);
    if (y >= ENOUGH * capacity(r)) {
      c.error = larger(c.error, larger(d, 0) / unit[r]);
    } else {
      c.error = larger(c.error, fabs(smaller(d, reach(r) * between(y, 0, capacity(r)))) / unit[r]);
      c.broken = larger(c.broken, -d / unit[r]);
    }
  }
  if (!all_finite(g, N * NU)) c.error = c.left = 10 * FINITE; /* fmax would hide NaN */
  return c;
}

/* Whether multipliers prove that no inputs within their limits keep the hard limits of states, along the model linearised at p: the
   sum of z times the violations is linear in the inputs, and above zero where it is least (Farkas). */
static int cannot_be_kept(const Limits* limits, const Point* p, casadi_real z[2][COUNT]) {
  int side, i, r, k, j, l;
  casadi_real push[COUNT], costate[NS], before[NS], sum = 0, size = 0;
  for (k = 0; k < COUNT; ++k) push[k] = 0;
  EACH_STATE_LIMIT(limits) {
    casadi_real y = hard[r - NU] == 0 ? 0 : between(z[side][k], 0, capacity(r));
    casadi_real violated = -y * distance(limits, p, side, i, r);
    push[k] -= SIGN(side) * y, sum += violated, size += fabs(violated);
  }
  for (j = 0; j < NS; ++j) costate[j] = 0;
  for (i = N; i-- > 0;) {
    for (j = 0; j < NB; ++j) costate[place[j]] += push[i * ROWS + NU + j];
    for (j = 0; j < NS; ++j) {
      casadi_real gap = costate[j] * (p->f[i * NS + j] - p->x[(i + 1) * NS + j]);
      sum += gap, size += fabs(gap);
    }
    for (l = 0; l < NU; ++l) {
      casadi_real slope = 0, steep = 0, low = limits->at[0][l], high = limits->at[1][l];
      for (j = 0; j < NS; ++j) {
        casadi_real part = p->b[(i * NU + l) * NS + j] * costate[j];
        slope += part, steep += fabs(part);
      }
      sum += slope * ((slope > 0 ? low : high) - p->u[i * NU + l]);
      size += steep * (high - low);
    }
    for (l = 0; l < NS; ++l) {
      before[l] = 0;
      for (j = 0; j < NS; ++j) before[l] += p->a[(i * NS + l) * NS + j] * costate[j];
    }
    for (j = 0; j < NS; ++j) costate[j] = before[j];
  }
  return size <= FINITE && sum > SURE * size; /* without a limit of an input nothing is proven */
}

/* The largest violation of a hard limit, as a share of its unit. */
static casadi_real outside(const Limits* limits, const Point* p) {
  int side, i, r, k;
  casadi_real worst = 0;
  EACH_STATE_LIMIT(limits)
    worst = larger(worst, -distance(limits, p, side, i, r) * hard[r - NU] / unit[r]);
  return worst;
}

/* Pure: limits that are active by the sign of gamma z - d are equalities, the others are not there. */
static void pure_terms(const Limits* limits, const Point* p, Duals* y, In g, int closed, Out weight, Out lean) {
  int side, i, r, k;
  for (k = 0; k < COUNT; ++k) weight[k] = lean[k] = 0;
  EACH_LIMIT(limits) {
    casadi_real d = distance(limits, p, side, i, r), *z = &y->z[side][k], kappa = STIFF / reach(r);
    /* An input on its limit that the cost holds there has a multiplier. */
    if (r < NU && closed && *z == 0 && d == 0) *z = larger(SIGN(side) * g[i * NU + r], 0);
    if (*z >= ENOUGH * capacity(r) && d < 0) {
      lean[k] -= SIGN(side) * capacity(r);
    } else if (reach(r) * *z > d) {
      weight[k] += kappa;
      lean[k] -= SIGN(side) * (*z - kappa * d);
    }
  }
}

static void pure_multipliers(const Limits* limits, const Point* p, const Duals* y, const Direction* move, casadi_real next[2][COUNT]) {
  int side, i, r, k;
  EACH_LIMIT(limits) {
    casadi_real d = distance(limits, p, side, i, r), z = y->z[side][k], kappa = STIFF / reach(r);
    if (z >= ENOUGH * capacity(r) && d < 0) next[side][k] = capacity(r);
    else if (reach(r) * z > d) next[side][k] = smaller(z - kappa * (SIGN(side) * moved(move, i, r) + d), capacity(r));
    else next[side][k] = 0;
  }
}

/* Interior: slacks, elastics and multipliers from the distances alone, or on the central path next to (d, z). */
static void put_inside(const Limits* limits, const Point* p, Duals* y, casadi_real mu, int warm) {
  int side, i, r, k;
  EACH_LIMIT(limits) {
    casadi_real d = distance(limits, p, side, i, r), m = d - reach(r) * y->z[side][k], rho = capacity(r), t, z, e = 0;
    t = sqrt(m * m + 4 * reach(r) * mu);
    t = !warm ? larger(d, 0.1 * unit[r]) : m > 0 ? 0.5 * (m + t) : 2 * reach(r) * mu / (t - m);
    z = mu / t;
    if (r >= NU) {
      e = larger(mu / (rho - smaller(z, 0.5 * rho)), z > 0.5 * rho ? -d : 0);
      z = larger(smaller(z, rho - mu / e), 0.5 * smaller(z, rho));
    }
    y->t[side][k] = t, y->z[side][k] = z, y->e[side][k] = e;
  }
}

/* Descent: slacks and elastics that belong to the distances, t - e = d and mu / t + mu / e = rho; `anew`: the multipliers too. */
static void put_on_path(const Limits* limits, const Point* p, Duals* y, casadi_real mu, int anew) {
  int side, i, r, k;
  EACH_LIMIT(limits) {
    casadi_real d = distance(limits, p, side, i, r), rho = capacity(r), reached, least;
    if (r < NU) {
      y->t[side][k] = larger(d, 0.1 * HAIR * unit[r]);
    } else {
      reached = rho * fabs(d) + sqrt(rho * d * rho * d + 4 * mu * mu);
      least = mu / rho + 2 * mu * mu / (rho * reached), reached = mu / rho + 0.5 * reached / rho;
      y->t[side][k] = d > 0 ? reached : least, y->e[side][k] = d > 0 ? least : reached;
    }
    if (anew) y->z[side][k] = mu / y->t[side][k];
  }
}

INLINE casadi_real kappa_of(casadi_real t, casadi_real z, casadi_real e, int r) {
  return 1 / (t / z + (r < NU ? 0 : e / (capacity(r) - z)));
}

INLINE casadi_real pull_of(casadi_real d, casadi_real z, casadi_real mu, int r) {
  return d - mu / z + (r < NU ? 0 : mu / (capacity(r) - z));
}

static void interior_terms(const Limits* limits, const Point* p, const Duals* y, casadi_real mu, Out weight, Out lean) {
  int side, i, r, k;
  for (k = 0; k < COUNT; ++k) weight[k] = lean[k] = 0;
  EACH_LIMIT(limits) {
    casadi_real z = y->z[side][k], kappa = kappa_of(y->t[side][k], z, y->e[side][k], r);
    weight[k] += kappa;
    lean[k] -= SIGN(side) * (z - kappa * pull_of(distance(limits, p, side, i, r), z, mu, r));
  }
}

/* Moves of slacks, elastics and multipliers; returns the largest share of each that keeps them positive. */
static void interior_moves(const Limits* limits, const Point* p, const Duals* y, Duals* by, const Direction* move, casadi_real mu,
                           casadi_real* primal, casadi_real* dual) {
  int side, i, r, k;
  casadi_real tau = larger(BOUNDARY, 1 - mu / COST);
  *primal = *dual = 1;
  EACH_LIMIT(limits) {
    casadi_real z = y->z[side][k], t = y->t[side][k], e = y->e[side][k], rho = capacity(r), dz, dt, de;
    dz = -kappa_of(t, z, e, r) * (SIGN(side) * moved(move, i, r) + pull_of(distance(limits, p, side, i, r), z, mu, r));
    dt = (mu - z * t - t * dz) / z;
    de = r < NU ? 0 : (mu - (rho - z) * e + e * dz) / (rho - z);
    by->z[side][k] = dz, by->t[side][k] = dt, by->e[side][k] = de;
    if (dt < 0) *primal = smaller(*primal, -tau * t / dt);
    if (de < 0) *primal = smaller(*primal, -tau * e / de);
    if (dz < 0) *dual = smaller(*dual, -tau * z / dz);
    if (dz > 0 && r >= NU) *dual = smaller(*dual, tau * (rho - z) / dz);
  }
}
