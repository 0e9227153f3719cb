@declaration@
static double frames[(CYCLES / FRAME + 1) * @numbers@];
static const int FOLLOWED[@count@] = {@followed@};
EXPORT("frames_at") void* frames_at(void) { return frames; }
/* Numbers of the mechanism's shapes and of the contraction, with the parameters and settings that the memory holds. */
static void draw(int row, const double* held) {
  static const double* from[@arg@];
  static double *to[@res@], values[@count@], own[@w@];
  static long long whole[@iw@];
  int j;
  for (j = 0; j < @count@; ++j) values[j] = trace[FOLLOWED[j]];
  from[0] = values, from[1] = held, to[0] = frames + row * @numbers@;
  lab_drawn_raw(from, to, whole, own, 0);
}