/* One library runs on every machine of its architecture: wider registers are used where there are some. Without fused
   multiply-add both round alike. */
#if defined(__GNUC__) && defined(__x86_64__)
__attribute__((target("avx2"))) static int run_wide(const casadi_real** arg, casadi_real** res) { return run(arg, res); }
static int can_run_wide(void) { return __builtin_cpu_supports("avx2"); }
#else
static int run_wide(const casadi_real** arg, casadi_real** res) { return 1; }
static int can_run_wide(void) { return 0; }
#endif
static int run_plain(const casadi_real** arg, casadi_real** res) { return run(arg, res); }

int ENTRY(const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, int mem) {
  (void)iw, (void)w, (void)mem;
  return can_run_wide() ? run_wide(arg, res) : run_plain(arg, res);
}
