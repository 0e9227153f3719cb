/* One plan of a horizon with limits of states: its expansion, its limits, and one Riccati sweep around it.

   Generated before this text: the stage functions evaluate, linearise, bend, curve, plain, end and deformed, and the sizes NS, NU,
   NT, NM and NH (partial derivatives of a stage and of its gradient), N and NB (bounded states). Entry r of stage i
   is input r, or the state place[r - NU] one stage later. Side 0 is its lower limit, side 1 the upper one; with the sign (1, -1)
   d = sign (w - limit) is a distance, and a multiplier z >= 0 adds -sign z to the gradient. A multiplier of a state is at most its
   capacity: beyond it the limit gives way (exact L1 penalty). */

#define PIVOT 1e-13   /* relative size of a pivot below which a matrix does not count as positive definite */
#define ENOUGH 0.99   /* share of the largest multiplier from which a limit counts as given up */
#define STIFF 1e8     /* weight of an equality, in units of 1 / gamma */
#define BOUNDARY 0.99 /* largest share of the distance to the boundary in one step */
#define HAIR 1e-8     /* of the unit: how far inside the limits of inputs descents stay */
#define CLOSED 1e-6   /* scaled gap below which a plan counts as a trajectory */
#define SURE 1e-9     /* of the summands: how far a sum must be above zero to be no rounding */

#define ROWS (NU + NB)
#define COUNT (N * ROWS)

typedef struct {
  casadi_real u[N * NU], x[(N + 1) * NS], f[N * NS], a[N * NS * NS], b[N * NS * NU], ls[N * NS], lu[N * NU];
  casadi_real tail[NS], final[NS * NS], value;
} Point;

/* Feedforward v, feedback K, the linear prediction (dx, du) and the costates of s_1 ... s_N. */
typedef struct {
  casadi_real v[N * NU], k[N * NU * NS], costates[(N + 1) * NS], dx[(N + 1) * NS], du[N * NU];
} Direction;

/* A sweep's cost to go. */
typedef struct {
  casadi_real values[(N + 1) * NS * NS], slopes[(N + 1) * NS];
} Scratch;

static const int place[SOME(NB)] = PLACES;
static const casadi_real curvature[NU] = CURVATURE; /* step times curvature of the cost rate */
static const casadi_real unit[SOME(ROWS)] = UNITS, spread[NS] = SPREADS;

/* Evaluate the plan at its own nodes, or (rolled) at the states that follow from s_0 with u = clip(U + K (x - X)), less the gaps that
   the plan is to have, if any; 0 where a function fails. */
static int evaluated(Point* p, In k, int rolled, In gaps, In s0, In data, In lower, In upper, Out partials) {
  int i, j, l;
  SLOTS;
  casadi_real cost, at[NS];
  for (j = 0; j < NS; ++j) at[j] = s0[j];
  p->value = 0;
  for (i = 0; i < N; ++i) {
    Out x = p->x + i * NS, u = p->u + i * NU;
    for (l = 0; l < NU && rolled; ++l) {
      for (j = 0; j < NS; ++j) u[l] += k[(i * NS + j) * NU + l] * (at[j] - x[j]);
      u[l] = between(u[l], lower[l], upper[l]);
    }
    for (j = 0; j < NS && (rolled || i == 0); ++j) x[j] = at[j];
    arg[0] = x, arg[1] = u, arg[2] = data + i * NT;
    res[0] = p->f + i * NS, res[1] = &cost, res[2] = partials + i * NM;
    NEEDED(evaluate);
    p->value += cost;
    for (j = 0; j < NS; ++j) at[j] = p->f[i * NS + j] - (gaps ? gaps[i * NS + j] : 0);
  }
  for (j = 0; j < NS && rolled; ++j) p->x[N * NS + j] = at[j];
  arg[0] = p->x + N * NS, arg[1] = data + N * NT;
  res[0] = &cost, res[1] = p->tail, res[2] = p->final;
  NEEDED(end);
  p->value += cost;
  return 1;
}

/* The derivatives of a plan that has just been evaluated; 0 when it is not finite. */
static int differentiated(Point* p, In partials) {
  int i;
  SLOTS;
  for (i = 0; i < N; ++i) {
    arg[0] = partials + i * NM;
    res[0] = p->a + i * NS * NS, res[1] = p->b + i * NS * NU, res[2] = p->ls + i * NS, res[3] = p->lu + i * NU;
    NEEDED(linearise);
  }
  return IS_FINITE(p);
}

static int expand(Point* p, In k, int rolled, In gaps, In s0, In data, In lower, In upper, Out partials) {
  return evaluated(p, k, rolled, gaps, s0, data, lower, upper, partials) && differentiated(p, partials);
}

/* L D L'; 0 when a pivot is not positive. */
INLINE int factorised(In matrix, Out lower, Out pivots) {
  int i, j, k, ok = 1;
  for (j = 0; j < NU; ++j) {
    casadi_real pivot = matrix[j * NU + j];
    for (k = 0; k < j; ++k) pivot -= lower[k * NU + j] * lower[k * NU + j] * pivots[k];
    ok &= pivot > PIVOT * fabs(matrix[j * NU + j]);
    pivots[j] = pivot;
    for (i = j + 1; i < NU; ++i) {
      casadi_real sum = matrix[j * NU + i];
      for (k = 0; k < j; ++k) sum -= lower[k * NU + i] * lower[k * NU + j] * pivots[k];
      lower[j * NU + i] = sum / pivots[j];
    }
  }
  return ok;
}

INLINE void solved(In lower, In pivots, Out column) {
  int i, k;
  for (i = 0; i < NU; ++i)
    for (k = 0; k < i; ++k) column[i] -= lower[k * NU + i] * column[k];
  for (i = 0; i < NU; ++i) column[i] /= pivots[i];
  for (i = NU - 1; i-- > 0;)
    for (k = i + 1; k < NU; ++k) column[i] -= lower[i * NU + k] * column[k];
}

/* Newton's step of all first-order conditions at once, with weights W and gradients w of the limits; 0 when some Q_uu is not positive.
   A plan (X, U) need not be a trajectory: its gaps are c_i = F(X_i, U_i) - X_{i+1}, and

       backward   P' = P + W,  p' = p + w + (P + W) c,   Q_uu = R + W_u + mu D^-1 + B'P'B,   K = -Q_uu^-1 (S + B'P'A),
                  v = -Q_uu^-1 (l_u + w_u + B'p'),       P <- Q + A'P'A + (S + B'P'A)'K,     p <- l_s + A'p' + (S + B'P'A)'v,
       forward    du = v + K dx,   dx+ = A dx + B du + c,   lambda = P' dx + p + w.

   Source for the gaps: H. G. Bock, K. J. Plitt, IFAC World Congress 1984. */
static int sweep(Direction* d, const Point* p, In weight, In lean, In costates, casadi_real delta, int use_exact, In data, Scratch* s) {
  int i, j, l, m;
  SLOTS;
  casadi_real *values = s->values, *slopes = s->slopes, factor[NU * NU];
  for (j = 0; j < NS * NS; ++j) values[N * NS * NS + j] = p->final[j];
  for (j = 0; j < NS; ++j) slopes[N * NS + j] = p->tail[j];
  for (i = N; i-- > 0;) {
    In a = p->a + i * NS * NS, b = p->b + i * NS * NU;
    Out value = values + (i + 1) * NS * NS, slope = slopes + (i + 1) * NS, k = d->k + i * NU * NS, v = d->v + i * NU;
    casadi_real q[NS * NS], cross[NU * NS], r[NU * NU], turned[NS * NS], flat[NU * NS];
    casadi_real bends[NH], pushed[NS], pivots[NU];
    for (m = 0; m < NB; ++m) {
      value[place[m] * NS + place[m]] += weight[i * ROWS + NU + m];
      slope[place[m]] += lean[i * ROWS + NU + m];
    }
    for (j = 0; j < NS; ++j) value[j * NS + j] += 0.01 * delta * COST / (spread[j] * spread[j]);
    arg[0] = p->x + i * NS, arg[1] = p->u + i * NU, arg[2] = data + i * NT, arg[3] = costates + (i + 1) * NS;
    if (use_exact) {
      res[0] = bends;
      NEEDED(bend);
      arg[0] = bends;
    }
    res[0] = q, res[1] = cross, res[2] = r;
    if (use_exact) NEEDED(curve);
    else NEEDED(plain);
    for (j = 0; j < NS; ++j) {
      pushed[j] = slope[j];
      for (m = 0; m < NS; ++m) pushed[j] += value[m * NS + j] * (p->f[i * NS + m] - p->x[(i + 1) * NS + m]);
    }
    condense(q, cross, r, value, a, b, turned);
    for (l = 0; l < NU; ++l) {
      r[l * NU + l] += weight[i * ROWS + l] + (DAMPING + delta) * curvature[l];
      v[l] = -p->lu[i * NU + l] - lean[i * ROWS + l];
      for (j = 0; j < NS; ++j) v[l] -= b[l * NS + j] * pushed[j];
    }
    if (!factorised(r, factor, pivots)) return 0;
    solved(factor, pivots, v);
    for (j = 0; j < NS; ++j) {
      for (l = 0; l < NU; ++l) k[j * NU + l] = -cross[j * NU + l];
      solved(factor, pivots, k + j * NU);
    }
    for (j = 0; j < NS; ++j) {
      casadi_real sum = p->ls[i * NS + j];
      for (m = 0; m < NS; ++m) sum += turned[m * NS + j] * pushed[m];
      for (l = 0; l < NU; ++l) sum += cross[j * NU + l] * v[l];
      slopes[i * NS + j] = sum;
    }
    transpose(flat, cross, NU, NS);
    multiply(q, flat, k, NS, NU, NS);
    for (j = 0; j < NS; ++j)
      for (m = 0; m < NS; ++m) values[(i * NS + j) * NS + m] = 0.5 * (q[j * NS + m] + q[m * NS + j]);
  }
  for (j = 0; j < NS; ++j) d->dx[j] = 0;
  for (i = 0; i < N; ++i) {
    Out dx = d->dx + i * NS, du = d->du + i * NU, next = dx + NS;
    for (l = 0; l < NU; ++l) {
      du[l] = d->v[i * NU + l];
      for (j = 0; j < NS; ++j) du[l] += d->k[(i * NS + j) * NU + l] * dx[j];
    }
    for (m = 0; m < NS; ++m) next[m] = p->f[i * NS + m] - p->x[(i + 1) * NS + m];
    for (j = 0; j < NS; ++j)
      for (m = 0; m < NS; ++m) next[m] += p->a[(i * NS + j) * NS + m] * dx[j];
    for (l = 0; l < NU; ++l)
      for (m = 0; m < NS; ++m) next[m] += p->b[(i * NU + l) * NS + m] * du[l];
    for (m = 0; m < NS; ++m) {
      casadi_real sum = slopes[(i + 1) * NS + m];
      for (j = 0; j < NS; ++j) sum += values[((i + 1) * NS + j) * NS + m] * next[j];
      d->costates[(i + 1) * NS + m] = sum;
    }
  }
  return all_finite(d->costates + NS, N * NS + (N + 1) * NS + N * NU);
}

#define SIDES 2
#define SIGN(side) (1 - 2 * (side))

typedef struct {
  casadi_real z[SIDES][COUNT], t[SIDES][COUNT], e[SIDES][COUNT]; /* multipliers, slacks, and by how much a limit gives way */
} Duals;

typedef struct {
  casadi_real at[SIDES][ROWS];
  int present[SIDES][ROWS];
} Limits;

typedef struct {
  casadi_real gap, error, left, violation, broken; /* largest gap, scaled error, stationarity, violation, and the share of a unit that is not certified */
} Certificate;

static const casadi_real state_limits[][SOME(NB)] = {STATE_LOWER, STATE_UPPER};

static const casadi_real capacities[SOME(NB)] = CAPACITIES, hard[SOME(NB)] = HARD;

INLINE casadi_real capacity(int r) { return r < NU ? BEYOND : capacities[r - NU]; }
INLINE casadi_real reach(int r) { return unit[r] * unit[r] / COST; } /* gamma */
INLINE casadi_real entry(const Point* p, int i, int r) { return r < NU ? p->u[i * NU + r] : p->x[(i + 1) * NS + place[r - NU]]; }
INLINE casadi_real moved(const Direction* d, int i, int r) { return r < NU ? d->du[i * NU + r] : d->dx[(i + 1) * NS + place[r - NU]]; }
INLINE casadi_real distance(const Limits* limits, const Point* p, int side, int i, int r) {
  return SIGN(side) * (entry(p, i, r) - limits->at[side][r]);
}

/* For every limit that there is: side, stage i, row r, and k = i ROWS + r. The rows of states are the last. */
#define EACH_LIMIT_FROM(first, limits)                                             \
  for (side = 0; side < SIDES; ++side)                                                 \
    for (r = first; r < ROWS; ++r)                                                 \
      if ((limits)->present[side][r])                                              \
        for (i = 0, k = r; i < N; ++i, k += ROWS)
#define EACH_LIMIT(limits) EACH_LIMIT_FROM(0, limits)
#define EACH_STATE_LIMIT(limits) EACH_LIMIT_FROM(NU, limits)

static void set_limits(Limits* limits, In lower, In upper) {
  int side, r;
  for (side = 0; side < SIDES; ++side)
    for (r = 0; r < ROWS; ++r) {
      casadi_real at = r < NU ? (side ? upper : lower)[r] : state_limits[side][r - NU];
      limits->present[side][r] = at <= FINITE && at >= -FINITE;
      limits->at[side][r] = at;
    }
}

/* Multipliers of states as they enter the gradient, whose other rows stay; where a limit is farther than `near` of its unit they count
   as zero. */
static void pushes(Out push, const Limits* limits, const Point* p, casadi_real z[][COUNT], casadi_real near) {
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

/* How far the plan is from the first-order conditions, with these multipliers of states; g is kept for the caller.

       E = max( |U - clip(U - gamma g)| / unit,  |gap| / unit,  |min(d, gamma z)| / unit,  gamma max(-z, 0) / unit )

   with g the reduced gradient with the multipliers. A limit that is given up (z = rho) need not be kept: its plan is a stationary
   point of the cost plus rho times the violations, so the limits cannot all be kept nearby. */
static Certificate certified(const Limits* limits, const Point* p, casadi_real z[][COUNT], Out g) {
  int side, i, r, k;
  casadi_real push[COUNT];
  Certificate c = {largest_gap(p), 0, 0, 0, 0};
  c.error = c.gap;
  pushes(push, limits, p, z, BEYOND);
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
  if (!all_finite(g, N * NU)) c.error = c.left = BEYOND; /* fmax would hide NaN */
  return c;
}

/* Whether multipliers prove that no inputs within their limits keep the hard limits of states, along the model linearised at p, which
   is rolled out: the violations are linear in the inputs, and so is

       sum z (violation) = sum -z d + sum g' (u - U),   lambda = A' (lambda + push),   g = B' (lambda + push).

   Where it is above zero even at its least in the box of the inputs, not all violations can be zero (Farkas' lemma). For a linear model
   this is a proof; for others it holds where the linearisation does. */
static int cannot_be_kept(const Limits* limits, const Point* p, casadi_real z[][COUNT]) {
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

/* Pure: limits that are active by the sign of gamma z - d are equalities, the others are not there.
   Source: M. Hintermueller, K. Ito, K. Kunisch, SIAM J. Optim. 13(3), 2002. */
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

static void pure_multipliers(const Limits* limits, const Point* p, const Duals* y, const Direction* move, casadi_real next[][COUNT]) {
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

/* The barrier's w - limit - t + e = 0, t z = mu, e (rho - z) = mu, linearised: its weight and its pull. */
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
