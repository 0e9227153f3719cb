/* One expansion along a plan, and one Riccati sweep around it, with the weights and gradients of its limits.

   Generated before this text: the stage functions evaluate, linearise, bend, curve, plain, end and deformed, and the sizes NS, NU,
   NT, NM and NH (partial derivatives of a stage and of its gradient), N and NB (bounded states). Entry r of stage i
   is input r, or the state place[r - NU] one stage later. */

#define ROWS (NU + NB)
#define COUNT (N * ROWS)

typedef struct {
  casadi_real u[N * NU], x[(N + 1) * NS], f[N * NS], a[N * NS * NS], b[N * NS * NU], ls[N * NS], lu[N * NU];
  casadi_real tail[NS], final[NS * NS], value;
} Point;

/* Feedforward v, feedback K, the linear prediction (dx, du) and the costates of s_1 ... s_N. */
typedef struct {
  casadi_real v[N * NU], k[N * NU * NS], dx[(N + 1) * NS], du[N * NU], costates[(N + 1) * NS];
} Direction;

/* A sweep's cost to go. */
typedef struct {
  casadi_real values[(N + 1) * NS * NS], slopes[(N + 1) * NS];
} Scratch;

static const int place[NB + 1] = PLACES;
static const casadi_real curvature[NU] = CURVATURE; /* step times curvature of the cost rate */
static const casadi_real unit[NU + NB + 1] = UNITS, spread[NS] = SPREADS;

/* Evaluate the plan at its own nodes, or (rolled) at the states that follow from s_0 with u = clip(U + K (x - X)), less the gaps that
   the plan is to have, if any; 0 where a function fails. */
static int evaluated(Point* p, In k, int rolled, In gaps, In s0, In data, In lower, In upper, Out partials) {
  int i, j, l;
  In arg[8];
  Out res[8];
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
    if (evaluate(arg, res, 0, 0, 0)) return 0;
    p->value += cost;
    for (j = 0; j < NS; ++j) at[j] = p->f[i * NS + j] - (gaps ? gaps[i * NS + j] : 0);
  }
  for (j = 0; j < NS && rolled; ++j) p->x[N * NS + j] = at[j];
  arg[0] = p->x + N * NS, arg[1] = data + N * NT;
  res[0] = &cost, res[1] = p->tail, res[2] = p->final;
  if (end(arg, res, 0, 0, 0)) return 0;
  p->value += cost;
  return 1;
}

/* The derivatives of a plan that has just been evaluated; 0 when it is not finite. */
static int differentiated(Point* p, In data, In partials) {
  int i, ok;
  In arg[8];
  Out res[8];
  for (i = 0; i < N; ++i) {
    arg[0] = partials + i * NM, arg[1] = data + i * NT;
    res[0] = p->a + i * NS * NS, res[1] = p->b + i * NS * NU, res[2] = p->ls + i * NS, res[3] = p->lu + i * NU;
    if (linearise(arg, res, 0, 0, 0)) return 0;
  }
  ok = all_finite(&p->value, 1) && all_finite(p->f, N * NS) && all_finite(p->ls, N * NS) && all_finite(p->lu, N * NU);
  return ok && all_finite(p->tail, NS) && all_finite(p->a, N * NS * NS) && all_finite(p->b, N * NS * NU);
}

static int expand(Point* p, In k, int rolled, In gaps, In s0, In data, In lower, In upper, Out partials) {
  return evaluated(p, k, rolled, gaps, s0, data, lower, upper, partials) && differentiated(p, data, partials);
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
  for (i = NU - 1; i >= 0; --i)
    for (k = i + 1; k < NU; ++k) column[i] -= lower[i * NU + k] * column[k];
}

/* Solve the quadratic model with these weights and gradients of the limits and with gaps; 0 when it is not convex. */
INLINE int sweep(Direction* d, const Point* p, In weight, In lean, In costates, casadi_real delta, int use_exact, In data, Scratch* s) {
  int i, j, l, m;
  In arg[8];
  Out res[8];
  casadi_real *values = s->values, *slopes = s->slopes, factor[NU * NU];
  for (j = 0; j < NS * NS; ++j) values[N * NS * NS + j] = p->final[j];
  for (j = 0; j < NS; ++j) slopes[N * NS + j] = p->tail[j];
  for (j = 0; j < NU * NU; ++j) factor[j] = 0; /* no compiler shall take it for unwritten */
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
      if (bend(arg, res, 0, 0, 0)) return 0;
      arg[0] = bends;
    }
    res[0] = q, res[1] = cross, res[2] = r;
    if (use_exact ? curve(arg, res, 0, 0, 0) : plain(arg, res, 0, 0, 0)) return 0;
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
  return all_finite(d->du, N * NU) && all_finite(d->dx, (N + 1) * NS) && all_finite(d->costates + NS, N * NS);
}

/* One library runs on every machine of its architecture: wider registers are used where there are some. Without fused
   multiply-add both round alike. */
#define SWEEP Direction *d, const Point *p, In weight, In lean, In costates, casadi_real delta, int use_exact, In data, Scratch *s
#ifdef PORTABLE
static int swept(SWEEP) { return sweep(d, p, weight, lean, costates, delta, use_exact, data, s); }
#else /* PORTABLE */
#if defined(__GNUC__) && defined(__x86_64__)
__attribute__((target("avx2"), noinline)) static int sweep_wide(SWEEP) { return sweep(d, p, weight, lean, costates, delta, use_exact, data, s); }
__attribute__((noinline)) static int sweep_plain(SWEEP) { return sweep(d, p, weight, lean, costates, delta, use_exact, data, s); }
static int swept(SWEEP) {
  return (__builtin_cpu_supports("avx2") ? sweep_wide : sweep_plain)(d, p, weight, lean, costates, delta, use_exact, data, s);
}
#else
static int swept(SWEEP) { return sweep(d, p, weight, lean, costates, delta, use_exact, data, s); }
#endif
#endif /* PORTABLE */
