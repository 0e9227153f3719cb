/* FixedPointSolver with limits of states, or where its plain iteration does not contract: pure and interior steps.

   Before this text stand kernels.c, state_limits_sweep.c, what they need, and the stage function guess, the sizes ITERATIONS and
   MEMORY, and the settings. One turn of the loop expands one plan, judges it, and finds the next one by a sweep. A phase of pure
   steps accepts a plan that halves the scaled error E of the first-order conditions, with patience for a few steps, because a change
   of the active limits raises E at first. A phase of interior steps accepts a plan by a filter of infeasibility theta and barrier
   function phi, as in IPOPT. Where the filter accepts none, a Levenberg-Marquardt term grows, then another first plan is tried, and
   at last descents: rollouts that carry a share of the gaps and lower phi + price sum |gaps| / unit (docs/theory.md). */

#define PATIENCE 3     /* pure steps in a row that may fail to halve the error: the active limits are changing */
#define HOPELESS 1e2   /* scaled error from which on there is no patience: multipliers are at their largest value */
#define AHEAD 0.1      /* of the tolerance: where one more step by Gauss-Newton is expected to arrive, the exact Hessian is not computed */
#define PURE_STEPS 10
#define FEASIBLE 1e-8  /* violation of a state bound, as a share of its unit, below which a call may end */
#define ROLLED_OUT 10.0 /* times FEASIBLE at which what is sent counts as converged: the roll-out of a plan moves it in its limits */
#define MU_WARM 1e-4   /* barrier parameter of a remembered plan, and how far it is raised, in units of the cost */
#define MU_MOST 0.1
#define MU_END 1e-5    /* where pure steps are tried first, and last: there limits whose multipliers nearly vanish are 1e-7 of a unit away */
#define MU_LEAST 1e-15
#define FILTER 64      /* pairs that the filter holds */
#define POOR 0.1       /* share of a step from a remembered plan below which its barrier is raised, at most so often in a call */
#define MOST_REWARMS 3
#define MOST_RAISES 12 /* of the Levenberg-Marquardt term before another first plan is tried */
#define ROUNDING OF_TYPE(1e-12, 1e-5) /* of the cost: smaller differences are rounding */
#define LEAST_DAMPING 1e-7 /* of the Levenberg-Marquardt term of descents, and of the fall that a plan of theirs must bring */
#define NEARLY 1.1     /* the price of gaps of a descent, in units of the largest costate: at least, and where it must rise */
#define ABOVE 2.0

/* First plans: the state held, its inputs rolled out, the reference; and, where all of these failed, those two for descents. */
enum { HELD, ROLLED, REFERENCE, DESCENT, LAST_START };
enum { PURE, INTERIOR };
enum { BEGINS, ENDS };                   /* where a pure phase stands: before an interior one, or after it */
enum { KEPT, COLD, WARM };               /* how an interior phase gets its slacks */

/* What is as long as a plan; it lies in the caller's work, ROOM numbers. */
typedef struct {
  Point points[2];
  Duals y, by;
  Direction move;
  casadi_real next_z[SIDES][COUNT], best_u[N * NU], best_x[(N + 1) * NS], best_z[SIDES][COUNT];
  casadi_real weight[COUNT], lean[COUNT], costates[(N + 1) * NS], g[N * NU], gaps[N * NS];
  union {
    casadi_real partials[N * NM]; /* while a plan is expanded */
    struct {
      Scratch scratch;
      Duals trial;
    } turn;
  } shared;
} Room;

FITS(Room, room_fits);

typedef struct {
  Room* room;
  Limits limits;
  casadi_real thetas[FILTER], phis[FILTER], inside[SIDES][NU], price, mu, floor, delta, error, alpha, alpha_dual, theta, phi, dphi;
  Certificate last;
  int phase, place_of, fresh, again, slacks, misses, steps, halvings, raises, filtered, start, use_exact, stuck, rolled, rewarms;
  int known;    /* whether a plan is remembered */
  int descends; /* whether interior plans are rollouts with gaps that lower phi, because the filter gave up */
} Machine;

static casadi_real sum_of_gaps(const Point* p) {
  int k;
  casadi_real sum = 0;
  for (k = 0; k < N * NS; ++k) sum += fabs(p->f[k] - p->x[k + NS]) / spread[k % NS];
  return sum;
}

static void log_terms(const Machine* m, const Point* p, const Duals* y, casadi_real* theta, casadi_real* phi) {
  int side, i, r, k;
  *theta = sum_of_gaps(p), *phi = p->value;
  EACH_LIMIT(&m->limits) {
    casadi_real t = y->t[side][k], e = y->e[side][k];
    *theta += fabs(distance(&m->limits, p, side, i, r) - t + e) / unit[r];
    *phi -= m->mu * log(t / unit[r]);
    if (r >= NU) *phi += capacity(r) * e - m->mu * log(e / unit[r]);
  }
}

/* The price of gaps with which phi + price |gaps| falls along every sweep: above the costates. It rises by a factor, or not at all. */
static casadi_real gap_price(const Machine* m) {
  int k;
  casadi_real largest = 0;
  for (k = 0; k < N * NS; ++k) largest = larger(largest, fabs(m->room->move.costates[k + NS]) * spread[k % NS]);
  return m->price >= NEARLY * largest ? m->price : ABOVE * largest;
}

/* Change of phi along the move, to first order. */
static casadi_real log_slope(const Machine* m, const Point* p) {
  int side, i, r, k;
  casadi_real sum = 0;
  for (k = 0; k < N * NU; ++k) sum += p->lu[k] * m->room->move.du[k];
  for (k = NS; k < (N + 1) * NS; ++k) sum += (k < N * NS ? p->ls[k] : p->tail[k - N * NS]) * m->room->move.dx[k];
  EACH_LIMIT(&m->limits) {
    sum -= m->mu * m->room->by.t[side][k] / m->room->y.t[side][k];
    if (r >= NU) sum += (capacity(r) - m->mu / m->room->y.e[side][k]) * m->room->by.e[side][k];
  }
  return sum;
}

/* The move of the inputs squared, in the unit of cost in which delta damps it. */
static casadi_real squared_move(const Machine* m) {
  int k;
  casadi_real sum = 0;
  for (k = 0; k < N * NU; ++k) sum += curvature[k % NU] * m->room->move.du[k] * m->room->move.du[k];
  return sum;
}

/* Scaled residual of the barrier problem without complementarity, whose products are between *least and *most. */
static casadi_real barrier_error(const Machine* m, const Point* p, casadi_real* least, casadi_real* most) {
  int side, i, r, k, j, l;
  casadi_real worst = largest_gap(p), push[COUNT];
  *least = BEYOND, *most = 0;
  for (k = 0; k < COUNT; ++k) push[k] = 0;
  EACH_LIMIT(&m->limits) {
    casadi_real t = m->room->y.t[side][k], z = m->room->y.z[side][k], e = m->room->y.e[side][k];
    push[k] -= SIGN(side) * z;
    worst = larger(worst, fabs(distance(&m->limits, p, side, i, r) - t + e) / unit[r]);
    *least = smaller(*least, t * z), *most = larger(*most, t * z);
    if (r < NU) continue;
    *least = smaller(*least, e * (capacity(r) - z)), *most = larger(*most, e * (capacity(r) - z));
  }
  for (i = 0; i < N; ++i) {
    In after = m->room->costates + (i + 1) * NS;
    casadi_real rest[NS];
    for (l = 0; l < NU; ++l) {
      casadi_real sum = p->lu[i * NU + l] + push[i * ROWS + l];
      for (j = 0; j < NS; ++j) sum += p->b[(i * NU + l) * NS + j] * after[j];
      worst = larger(worst, fabs(sum) * unit[l] / COST);
    }
    for (l = 0; l < NS; ++l) {
      rest[l] = -after[l];
      if (i + 1 == N) rest[l] += p->tail[l];
      else for (rest[l] += p->ls[(i + 1) * NS + l], j = 0; j < NS; ++j)
        rest[l] += p->a[((i + 1) * NS + l) * NS + j] * after[NS + j];
    }
    for (l = 0; l < NB; ++l) rest[place[l]] += push[i * ROWS + NU + l];
    for (l = 0; l < NS; ++l) worst = larger(worst, fabs(rest[l]) * spread[l] / COST);
  }
  return worst;
}

static int is_done(const Certificate* c, casadi_real feasible) {
  return c->left <= TOLERANCE && c->broken <= feasible && c->error <= SCALED_TOLERANCE;
}

/* The stationarity with which a plan is returned: multipliers of limits that are not near count as zero. */
static casadi_real returned_left(Machine* m, const Point* p) {
  int k;
  casadi_real push[COUNT], g[N * NU], left = 0;
  pushes(push, &m->limits, p, m->room->y.z, NEAR_LIMIT);
  adjoint(p, push, g);
  for (k = 0; k < N * NU; ++k) {
    casadi_real u = p->u[k];
    left = larger(left, fabs(u - between(u - g[k] / curvature[k % NU], m->limits.at[0][k % NU], m->limits.at[1][k % NU])));
  }
  return all_finite(g, N * NU) ? left : BEYOND;
}

/* Begin without a memory: the inputs given or fed forward; the state held, rolled out, or the reference. */
static void begin_cold(Machine* m, Point* p, In s0, In data, In lower, In upper, In inputs) {
  int i, j, l;
  casadi_real x[NS], u[NU];
  for (i = 0; i <= N; ++i) {
    SLOTS;
    arg[0] = data + i * NT, res[0] = x, res[1] = u;
    CALLED(guess);
    for (j = 0; j < NS; ++j) p->x[i * NS + j] = m->start == REFERENCE || m->start == DESCENT ? x[j] : s0[j];
    for (l = 0; l < NU && i < N; ++l) {
      casadi_real hair = smaller(0.01 * unit[l], 0.25 * (upper[l] - lower[l]));
      p->u[i * NU + l] = between(inputs && m->start == 0 ? inputs[i * NU + l] : u[l], lower[l] + hair, upper[l] - hair);
    }
  }
  for (j = 0; j < N * NU * NS; ++j) m->room->move.k[j] = 0;
  for (j = 0; j < (N + 1) * NS; ++j) m->room->costates[j] = 0;
  m->phase = INTERIOR, m->slacks = COLD, m->fresh = 1, m->use_exact = 0;
  m->descends = m->start >= DESCENT, m->price = COST;
  m->mu = COST, m->floor = MU_END * COST, m->delta = m->descends ? LEAST_DAMPING : 0;
  m->filtered = m->raises = m->halvings = 0;
}

static void restart(Machine* m, Point* p, In s0, In data, In lower, In upper) {
  if (++m->start > LAST_START) m->stuck = 1;
  else begin_cold(m, p, s0, data, lower, upper, 0);
}

/* Limits of the inputs of a rollout: a hair inside for descents, whose barrier they must not touch. */
static In box(Machine* m, int side, In limit, In other) {
  int l;
  if (!m->descends || m->phase != INTERIOR) return limit;
  for (l = 0; l < NU; ++l)
    m->inside[side][l] = limit[l] + SIGN(side) * smaller(HAIR * unit[l], 0.25 * fabs(other[l] - limit[l]));
  return m->inside[side];
}

static void keep(Machine* m, const Point* p) {
  int k;
  for (k = 0; k < N * NU; ++k) m->room->best_u[k] = p->u[k];
  for (k = NS; k < (N + 1) * NS; ++k) m->room->best_x[k] = p->x[k];
  for (k = 0; k < COUNT; ++k) m->room->best_z[0][k] = m->room->y.z[0][k], m->room->best_z[1][k] = m->room->y.z[1][k];
}

/* Leave the pure phase: for an interior phase near its best plan, or back to the interior plan it came from. */
static void enter_interior(Machine* m, Point* p) {
  int k;
  m->phase = INTERIOR, m->again = m->use_exact = 1, m->filtered = m->raises = m->halvings = 0;
  if (m->place_of == BEGINS) {
    m->slacks = WARM;
    m->mu = MU_WARM * COST, m->floor = MU_END * COST;
    if (m->misses == 0) return;
  }
  for (k = 0; k < N * NU; ++k) p->u[k] = m->room->best_u[k];
  for (k = NS; k < (N + 1) * NS; ++k) p->x[k] = m->room->best_x[k];
  for (k = 0; k < COUNT; ++k) m->room->y.z[0][k] = m->room->best_z[0][k], m->room->y.z[1][k] = m->room->best_z[1][k];
  m->fresh = 1;
  if (m->place_of == BEGINS) return;
  m->floor *= 0.01, m->slacks = KEPT;
  m->stuck |= m->floor < MU_LEAST * COST;
}

static void enter_pure(Machine* m, const Point* p, int place_of) {
  m->phase = PURE, m->place_of = place_of, m->misses = m->steps = 0;
  keep(m, p);
  m->last = certified(&m->limits, p, m->room->y.z, m->room->g);
  m->error = m->last.error;
}

/* After an accepted interior plan: lower mu, and see whether pure steps can end it. */
static void advance_interior(Machine* m, const Point* p) {
  casadi_real least, most, rest = barrier_error(m, p, &least, &most);
  for (;;) {
    casadi_real worst = larger(rest, larger(most - m->mu, least < FINITE ? m->mu - least : 0) / COST);
    if (worst > 10 * m->mu / COST || m->mu <= m->floor) break;
    m->mu = larger(m->floor, smaller(0.2 * m->mu, m->mu * sqrt(m->mu / COST)));
    m->filtered = 0;
  }
  if (m->mu <= m->floor && larger(rest, most / COST) <= 0.3 * sqrt(m->floor / COST)) enter_pure(m, p, ENDS);
}

/* A remembered plan that a step can hardly leave is too near its limits for its barrier: take a higher one, and slacks to it. */
static int rewarmed(Machine* m) {
  if (m->start >= 0 || m->place_of != BEGINS || m->alpha >= POOR || m->rewarms >= MOST_REWARMS || m->mu >= MU_MOST * COST) return 0;
  m->mu = smaller(10 * m->mu, MU_MOST * COST), m->slacks = WARM, m->filtered = 0;
  return ++m->rewarms;
}

/* Sources: R. Fletcher, S. Leyffer, Math. Program. 91, 2002; A. Waechter, L. T. Biegler, Math. Program. 106, 2006, section 2.3. */
static int passes(Machine* m, casadi_real theta, casadi_real phi) {
  int k, falls, descends;
  casadi_real slack = ROUNDING * (COST + fabs(m->phi));
  for (k = 0; k < m->filtered; ++k)
    if (theta > (1 - 1e-5) * m->thetas[k] && phi > m->phis[k] - 1e-5 * m->thetas[k] * COST) return 0;
  if (theta <= m->theta && phi <= m->phi + slack) return 1;
  descends = m->dphi < 0 && m->theta <= 1e-4 * N && pow(m->alpha * -m->dphi / COST, 2.3) > pow(m->theta, 1.1);
  if (descends) return phi <= m->phi + 1e-4 * m->alpha * m->dphi + slack;
  falls = theta <= (1 - 1e-5) * m->theta || phi <= m->phi - 1e-5 * m->theta * COST;
  if (falls && m->filtered < FILTER) m->thetas[m->filtered] = m->theta, m->phis[m->filtered++] = m->phi;
  return falls;
}

/* A descent must lower phi by a share of its slope, and by a share of the move itself: the exact Hessian may be nearly singular. */
static int falls_enough(const Machine* m, casadi_real phi) {
  return phi <= m->phi + 1e-4 * m->alpha * m->dphi + ROUNDING * (COST + fabs(m->phi));
}

static void trial_duals(const Machine* m, const Point* p, Duals* y) {
  int side, i, r, k;
  if (m->descends) put_on_path(&m->limits, p, y, m->mu, 0);
  EACH_LIMIT(&m->limits) {
    if (!m->descends) {
      y->t[side][k] = m->room->y.t[side][k] + m->alpha * m->room->by.t[side][k];
      y->e[side][k] = m->room->y.e[side][k] + m->alpha * m->room->by.e[side][k];
    }
    y->z[side][k] = m->room->y.z[side][k] + m->alpha_dual * m->room->by.z[side][k];
    y->z[side][k] = between(y->z[side][k], m->mu / (1e8 * y->t[side][k]), 1e8 * m->mu / y->t[side][k]);
    (void)i, (void)r;
  }
}

static void adopt_costates(Machine* m, casadi_real share) {
  int k;
  for (k = NS; k < (N + 1) * NS; ++k) m->room->costates[k] += share * (m->room->move.costates[k] - m->room->costates[k]);
}

/* Judge the plan that was expanded; returns whether it is the new one. */
static int judged(Machine* m, Point* old, Point* p, int ok, int rolled, In s0, In data, In lower, In upper) {
  Duals* y = &m->room->shared.turn.trial;
  casadi_real theta, phi;
  int k;
  if (m->fresh) {
    m->fresh = 0;
    for (k = 0; k < (N + 1) * NS && rolled; ++k) ok &= fabs(p->x[k]) <= 100 * spread[k % NS];
    if (!ok) { restart(m, p, s0, data, lower, upper); return 1; }
    if (m->phase == PURE) enter_pure(m, p, BEGINS);
    return 1;
  }
  if (m->phase == PURE) {
    casadi_real g[N * NU];
    Certificate c;
    int halved, waits;
    ok = ok && (c = certified(&m->limits, p, m->room->next_z, g), c.error < FINITE);
    halved = ok && c.error <= 0.5 * m->error;
    waits = m->misses < PATIENCE && c.error < HOPELESS;
    ok = ok && (halved || waits) && ++m->steps <= PURE_STEPS;
    if (!ok) { enter_interior(m, old); return 0; }
    /* Gauss-Newton goes on only where the contraction that was seen ends the call with one more step. */
    m->use_exact |= c.error * c.error > AHEAD * SCALED_TOLERANCE * m->error;
    m->misses = halved ? 0 : m->misses + 1;
    for (k = 0; k < COUNT; ++k) m->room->y.z[0][k] = m->room->next_z[0][k], m->room->y.z[1][k] = m->room->next_z[1][k];
    for (k = 0; k < N * NU; ++k) m->room->g[k] = g[k];
    m->last = c;
    adopt_costates(m, 1);
    if (halved) {
      m->error = c.error;
      if (m->place_of == BEGINS) keep(m, p);
    }
    return 1;
  }
  *y = m->room->y;
  if (ok) {
    trial_duals(m, p, y);
    log_terms(m, p, y, &theta, &phi);
    phi += m->descends ? m->price * sum_of_gaps(p) : 0;
    ok = fabs(phi) <= FINITE && fabs(theta) <= FINITE && (m->descends ? falls_enough(m, phi) : passes(m, theta, phi));
  }
  if (ok) {
    adopt_costates(m, m->alpha);
    m->room->y = *y;
    m->delta = m->halvings >= 3 ? larger(4 * m->delta, 1e-4) : m->halvings ? m->delta : m->delta > 5e-7 ? m->delta / 5 : 0;
    if (m->descends) m->delta = larger(m->delta, LEAST_DAMPING);
    m->halvings = m->raises = 0;
    if (!rewarmed(m)) advance_interior(m, p);
    return 1;
  }
  if (++m->halvings <= 8) { m->alpha *= 0.5; return 0; }
  m->halvings = m->filtered = 0;
  m->delta = larger(10 * m->delta, 1e-3);
  /* The barrier of a remembered plan has been raised before: a first guess is cheaper than damping. */
  if (m->start < 0 || ++m->raises > MOST_RAISES || m->delta > 1e8) { restart(m, old, s0, data, lower, upper); return 0; }
  if (m->descends) m->use_exact = 0;
  m->again = 1; /* the same plan, a shorter step */
  return 0;
}

/* One sweep for the next plan: pure, or interior with the largest step that stays inside. */
static void direct(Machine* m, Point* p, In s0, In data, In lower, In upper) {
  int ok;
  if (m->phase == PURE) {
    pure_terms(&m->limits, p, &m->room->y, m->room->g, m->last.gap < CLOSED, m->room->weight, m->room->lean);
  } else {
    if (m->slacks != KEPT) put_inside(&m->limits, p, &m->room->y, m->mu, m->slacks == WARM);
    if (m->descends) put_on_path(&m->limits, p, &m->room->y, m->mu, m->slacks == COLD);
    interior_terms(&m->limits, p, &m->room->y, m->mu, m->room->weight, m->room->lean);
    m->slacks = KEPT;
  }
  ok = m->use_exact && sweep(&m->room->move, p, m->room->weight, m->room->lean, m->room->costates, m->delta, 1, data, &m->room->shared.turn.scratch);
  ok = ok || sweep(&m->room->move, p, m->room->weight, m->room->lean, m->room->costates, m->delta, 0, data, &m->room->shared.turn.scratch);
  m->use_exact |= m->phase == INTERIOR || !ok;
  if (!ok) {
    m->delta = larger(10 * m->delta, 1e-6);
    m->fresh = 1; /* try again from the same plan */
    if (m->delta > 1e8) restart(m, p, s0, data, lower, upper);
  } else if (m->phase == PURE) {
    pure_multipliers(&m->limits, p, &m->room->y, &m->room->move, m->room->next_z);
  } else {
    interior_moves(&m->limits, p, &m->room->y, &m->room->by, &m->room->move, m->mu, &m->alpha, &m->alpha_dual);
    log_terms(m, p, &m->room->y, &m->theta, &m->phi);
    m->dphi = log_slope(m, p);
    if (m->descends) {
      casadi_real apart = sum_of_gaps(p);
      m->price = gap_price(m), m->phi += m->price * apart;
      m->dphi = smaller(m->dphi - m->price * apart, -LEAST_DAMPING * squared_move(m));
    }
  }
}

static void begin(Machine* m, Room* room, Point* p, In memory, In s0, In data, In lower, In upper) {
  int k, has_guess = 0;
  In z = memory + N * NU + 2 * N * NS + N * NU * NS;
  memset(m, 0, sizeof *m);
  m->room = room;
  set_limits(&m->limits, lower, upper);
  m->known = all_finite(memory, MEMORY) && memory[MEMORY - 2] > 0;
  for (k = 0; k < COUNT; ++k) m->room->y.z[0][k] = m->known ? z[k] : 0, m->room->y.z[1][k] = m->known ? z[COUNT + k] : 0;
  for (k = 0; k < COUNT; ++k) m->room->next_z[0][k] = m->room->next_z[1][k] = 0; /* limits that are not there stay so */
  m->start = m->known ? -1 : 0;
  if (!m->known) {
    for (k = 0; k < N * NU; ++k) has_guess |= memory[k] != 0;
    begin_cold(m, p, s0, data, lower, upper, has_guess && all_finite(memory, N * NU) ? memory : 0);
    return;
  }
  for (k = 0; k < N * NU; ++k) p->u[k] = between(memory[k], lower[k % NU], upper[k % NU]);
  for (k = 0; k < N * NS; ++k) p->x[NS + k] = memory[N * NU + k], m->room->costates[NS + k] = memory[N * NU + N * NS + k];
  for (k = 0; k < N * NU * NS; ++k) m->room->move.k[k] = memory[N * NU + 2 * N * NS + k];
  m->delta = memory[MEMORY - 1];
  m->phase = PURE, m->place_of = BEGINS, m->fresh = 1, m->slacks = WARM, m->use_exact = !PLAIN_FIRST;
}

static void remember(const Machine* m, const Point* p, Out memory) {
  int k;
  Out z = memory + N * NU + 2 * N * NS + N * NU * NS;
  for (k = 0; k < N * NU; ++k) memory[k] = p->u[k];
  for (k = 0; k < N * NS; ++k) memory[N * NU + k] = p->x[NS + k], memory[N * NU + N * NS + k] = m->room->costates[NS + k];
  for (k = 0; k < N * NU * NS; ++k) memory[N * NU + 2 * N * NS + k] = m->room->move.k[k];
  for (k = 0; k < COUNT; ++k) z[k] = m->room->y.z[0][k], z[COUNT + k] = m->room->y.z[1][k];
  memory[MEMORY - 2] = MU_WARM;
  memory[MEMORY - 1] = m->delta;
}

/* The next plan to expand stands in p; returns whether it is rolled out. */
static int next_plan(Machine* m, const Point* best, Point* p) {
  int k, pure = !m->fresh && m->phase == PURE, descends = m->phase == INTERIOR && m->descends;
  casadi_real share = m->fresh || pure ? 0 : m->alpha;
  In du = descends ? m->room->move.v : m->room->move.du;
  for (k = 0; k < N * NU; ++k) p->u[k] = best->u[k] + (share > 0 ? share * du[k] : 0);
  for (k = 0; k < (N + 1) * NS; ++k) p->x[k] = best->x[k] + (share > 0 && !descends ? share * m->room->move.dx[k] : 0);
  if (pure) {
    casadi_real made[N * NU];
    SLOTS;
    arg[0] = m->room->move.v, res[0] = made;
    CALLED(deformed);
    for (k = 0; k < N * NU; ++k) p->u[k] += made[k];
  }
  for (k = 0; k < N * NS; ++k) m->room->gaps[k] = descends ? (1 - share) * (best->f[k] - best->x[k + NS]) : 0;
  if (descends && !m->fresh) return 1;
  return m->fresh ? m->slacks == COLD && m->start == ROLLED : pure;
}

/* Cost of a plan with the price of its violations. */
static casadi_real priced_cost(const Limits* limits, const Point* p) {
  int side, i, r, k;
  casadi_real sum = p->value;
  EACH_STATE_LIMIT(limits)
    sum += capacity(r) * larger(-distance(limits, p, side, i, r), 0);
  return sum;
}

/* The remembered plan, rolled out with its feedback; 0 where there is none, it is not finite, or it costs as much as the other plan,
   if any: its derivatives are then not wanted. */
static int plan_in_force(Machine* m, Point* p, const Point* other, In memory, In s0, In data, In lower, In upper) {
  int k;
  if (!m->known) return 0;
  for (k = 0; k < N * NU; ++k) p->u[k] = memory[k];
  for (k = 0; k < NS; ++k) p->x[k] = s0[k];
  for (k = 0; k < N * NS; ++k) p->x[NS + k] = memory[N * NU + k];
  if (!evaluated(p, memory + N * NU + 2 * N * NS, 1, 0, s0, data, lower, upper, m->room->shared.partials)) return 0;
  if (other && !(priced_cost(&m->limits, p) < priced_cost(&m->limits, other))) return 0;
  return differentiated(p, m->room->shared.partials);
}

int ENTRY(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  NOTHING;
  In s0 = GIVEN(0), data = GIVEN(1), lower = GIVEN(2), upper = GIVEN(3), memory = GIVEN(4);
  Room* room = (Room*)w;
  Machine m;
  Point *best = room->points, *p = room->points + 1, *other;
  const Point* certain; /* the plan whose certificate is known */
  casadi_real left = 0;
  Certificate c = {0, 0, 0, 0, 0};
  int i, posed = sane(s0, data, lower, upper), count = 0, empty = 0, status, held, ok, ended = 0;
  (void)iw, (void)mem;
  for (i = 0; i < NU; ++i) empty |= lower[i] > upper[i];
  begin(&m, room, best, memory, s0, data, lower, upper);
  for (; posed; ++count) {
    int final = count == ITERATIONS, rolled = next_plan(&m, best, p), accepted;
    ok = expand(p, m.room->move.k, rolled, m.room->gaps, s0, data, box(&m, 0, lower, upper), box(&m, 1, upper, lower), room->shared.partials);
    accepted = judged(&m, best, p, ok, rolled, s0, data, lower, upper);
    if (accepted) other = best, best = p, p = other, m.rolled = rolled && !m.descends;
    ended = !m.fresh && m.phase == PURE && is_done(&m.last, FEASIBLE) && (left = returned_left(&m, best)) <= TOLERANCE;
    if (final || m.stuck || ended) break;
    if (!m.fresh && (accepted || m.again)) m.again = 0, direct(&m, best, s0, data, lower, upper);
  }
  certain = !m.fresh && m.phase == PURE ? best : 0;
  ok = posed;
  if (posed && (!m.rolled || m.fresh)) {
    *p = *best;
    ok = expand(p, m.room->move.k, 1, 0, s0, data, lower, upper, room->shared.partials);
    if (ok) best = p;
  }
  if (posed && !ended) {
    p = best == m.room->points ? m.room->points + 1 : m.room->points;
    held = plan_in_force(&m, p, ok ? best : 0, memory, s0, data, lower, upper);
    ok |= held, best = held ? p : best;
  }
  if (ok) {
    casadi_real g[N * NU];
    c = best == certain ? m.last : certified(&m.limits, best, m.room->y.z, g);
    c.left = ended && best == certain ? left : returned_left(&m, best);
    ok = c.error < FINITE;
  }
  /* A call that ends at its most iterations may still get inside, unless multipliers prove that it does not; one that has tried
     everything has not. */
  if (is_done(&c, ROLLED_OUT * FEASIBLE)) status = ok && outside(&m.limits, best) > KEPT_SHARE ? INFEASIBLE : CONVERGED;
  else if (outside(&m.limits, best) > NEAR_LIMIT && (m.stuck || cannot_be_kept(&m.limits, best, m.room->y.z))) status = INFEASIBLE;
  else status = NOT_CONVERGED;
  status = empty ? INFEASIBLE : !ok ? NON_FINITE : status;
  if (res[0])
    for (i = 0; i < N * NU; ++i)
      res[0][i] = between(ok ? best->u[i] : all_finite(memory, MEMORY) ? memory[i] : 0, lower[i % NU], upper[i % NU]);
  if (res[1]) {
    res[1][0] = ok ? best->value : 0, res[1][1] = ok ? c.left : 0, res[1][2] = ok ? larger(c.violation, 0) : 0;
    res[1][3] = count, res[1][4] = status;
  }
  if (res[2]) {
    if (ok) remember(&m, best, res[2]);
    else for (i = 0; i < MEMORY; ++i) res[2][i] = posed ? 0 : memory[i];
  }
  return 0;
}
