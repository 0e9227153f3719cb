/* What the loops of the optimisers share: small matrix products and tests of numbers. Matrices are column-major. */

typedef const casadi_real* In;
typedef casadi_real* Out;

#define BEYOND (10 * FINITE) /* every number */
#define SOME(count) ((count) + 1) /* so that no array is empty */
#define GIVEN(k) (arg[k] ? arg[k] : nothing) /* CasADi passes no address for zeros */
#define NOTHING static const casadi_real nothing[(N + 1) * NT + MEMORY + NS + NU]
/* A stage function needs no work; where it fails, so does the function that calls it, and returns 0. */
#define SLOTS In arg[8]; Out res[8]
#define CALLED(leaf) (void)leaf(arg, res, 0, 0, 0)
#define NEEDED(leaf) do { if (leaf(arg, res, 0, 0, 0)) return 0; } while (0)
/* Structs of numbers alone. */
#define FITS(type, fits) typedef char fits[sizeof(type) == ROOM * sizeof(casadi_real) ? 1 : -1]
#define IS_FINITE(of) all_finite((In)(of), sizeof *(of) / sizeof(casadi_real))

/* fmax and fmin without calls of the library: where one is not a number, the other. */
INLINE casadi_real larger(casadi_real a, casadi_real b) { return ((a > b) | (b != b)) ? a : b; }
INLINE casadi_real smaller(casadi_real a, casadi_real b) { return ((a < b) | (b != b)) ? a : b; }

/* fmin(fmax(v, low), high) without calls of the library: a v that is not a number becomes low there and here. */
INLINE casadi_real between(casadi_real v, casadi_real low, casadi_real high) {
  casadi_real above = v > low ? v : low;
  return above < high ? above : high;
}

/* c (rows, columns) += a (rows, inner) b (inner, columns). Blocks of eight and of four rows are added up in registers. */
INLINE void multiply(Out restrict c, In restrict a, In restrict b, int rows, int inner, int columns) {
  int i, j, k, r;
  NOT_UNROLLED
  for (j = 0; j < columns; ++j) {
    Out column = c + j * rows;
    In factors = b + j * inner;
    for (i = 0; i + 8 <= rows; i += 8) {
      casadi_real sum[8];
      for (r = 0; r < 8; ++r) sum[r] = column[i + r];
      for (k = 0; k < inner; ++k)
        for (r = 0; r < 8; ++r) sum[r] += factors[k] * a[k * rows + i + r];
      for (r = 0; r < 8; ++r) column[i + r] = sum[r];
    }
    for (; i + 4 <= rows; i += 4) {
      casadi_real sum[4];
      for (r = 0; r < 4; ++r) sum[r] = column[i + r];
      for (k = 0; k < inner; ++k)
        for (r = 0; r < 4; ++r) sum[r] += factors[k] * a[k * rows + i + r];
      for (r = 0; r < 4; ++r) column[i + r] = sum[r];
    }
    for (; i < rows; ++i) {
      casadi_real sum = column[i];
      for (k = 0; k < inner; ++k) sum += factors[k] * a[k * rows + i];
      column[i] = sum;
    }
  }
}

INLINE void transpose(Out restrict to, In restrict from, int rows, int columns) {
  int i, j;
  for (j = 0; j < columns; ++j)
    for (i = 0; i < rows; ++i) to[i * columns + j] = from[j * rows + i];
}

/* A stage's Hessian with the cost to go P behind it: Q += A'PA, S += B'PA, R += B'PB; turned = A' */
INLINE void condense(Out q, Out cross, Out r, In p, In a, In b, Out turned) {
  casadi_real ahead[NS * NS], along[NS * NU], flat[NU * NS];
  int j;
  for (j = 0; j < NS * NS; ++j) ahead[j] = 0;
  for (j = 0; j < NS * NU; ++j) along[j] = 0;
  multiply(ahead, p, a, NS, NS, NS);
  multiply(along, p, b, NS, NS, NU);
  transpose(turned, a, NS, NS);
  transpose(flat, b, NS, NU);
  multiply(q, turned, ahead, NS, NS, NS);
  multiply(cross, flat, ahead, NU, NS, NS);
  multiply(r, flat, along, NU, NS, NU);
}

INLINE int sane(In s0, In data, In lower, In upper) {
  int l;
  int ok = all_finite(s0, NS) & all_finite(data, (N + 1) * NT);
  for (l = 0; l < NU; ++l) ok &= (lower[l] <= upper[l]) & (lower[l] <= FINITE) & (upper[l] >= -FINITE);
  return ok;
}
