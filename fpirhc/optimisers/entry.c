/* One library runs on every machine of its architecture: wider registers are used where there are some. Without fused
   multiply-add both round alike. A library for one machine, which is known to have them (ALWAYS_WIDE), has the wider code alone. */
#ifdef PORTABLE
static int run_plain(const casadi_real** arg, casadi_real** res, casadi_real* w) { return run(arg, res, w); }
#define run_wide run_plain
#else /* PORTABLE */
#if defined(__GNUC__) && defined(__x86_64__)
__attribute__((target("avx2"))) static int run_wide(const casadi_real** arg, casadi_real** res, casadi_real* w) { return run(arg, res, w); }
#else
static int run_wide(const casadi_real** arg, casadi_real** res, casadi_real* w) { return 1; }
#endif
#ifdef ALWAYS_WIDE
#define run_plain run_wide
#else
static int run_plain(const casadi_real** arg, casadi_real** res, casadi_real* w) { return run(arg, res, w); }
#endif
#endif /* PORTABLE */

#ifdef PORTABLE
#else /* PORTABLE */
#ifdef GAINS
/* A call whose memory, in which the gains of the search lie, nobody wants. */
#if defined(__GNUC__)
__attribute__((noinline))
#endif
static int unwanted(const casadi_real** arg, casadi_real** res, casadi_real* w) {
  casadi_real memory[MEMORY];
  casadi_real* made[3];
  made[0] = res[0], made[1] = res[1], made[2] = memory;
  return WIDE ? run_wide(arg, made, w) : run_plain(arg, made, w);
}
#endif
#endif /* PORTABLE */

int ENTRY(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  (void)iw, (void)mem;
#ifdef PORTABLE
#else /* PORTABLE */
#ifdef GAINS
  if (!res[2]) return unwanted(arg, res, w);
#endif
#endif /* PORTABLE */
  return WIDE ? run_wide(arg, res, w) : run_plain(arg, res, w);
}
