/* Limits to what inputs change by in a step: bounds that move with the input before, which x carries.
 *
 * Input a stays within rate_down[a] and rate_up[a] of x[rate_place[a]] (-1: it has no such limits), in every trajectory. An
 * input at such a bound moves along with the one before: its row of K has a one there.
 *
 * Plans that rise and fall as fast as they may meet bounds that stay where they are in corners: an input at both kinds of
 * bounds is pushed by the one before, but not taken back. There V has a kink in that one: its slope is larger above. Place
 * and slopes are carried through the Riccati recursion, and where zero lies between these, the kink is one more bound of
 * the input: with one slope alone a step would be promised that cannot be made.
 *
 * Included after core.c.
 */
#if RATES
#define CORNER 1e-2 /* of the rate: bounds that are no farther apart make a kink; others are met by shorter steps */

static kinks no_kinks(void) {
    kinks v;
    for (int a = 0; a < NU; ++a) v.up[a] = v.down[a] = v.place[a] = V(0.0);
    return v;
}

static double corner_of(double rate) { return rate < INFINITY ? CORNER * rate : -1.0; }

static inline vd least_of(const mpc_problem *m, const lanes *w, int64_t k, int a) { return k ? V(m->low[a]) : w->low0[a]; }
static inline vd most_of(const mpc_problem *m, const lanes *w, int64_t k, int a) { return k ? V(m->high[a]) : w->high0[a]; }

/* Before a step of a stage's inputs is looked for: the slopes that it has to look at, and its bounds. */
static void before_step(const mpc_problem *m, const lanes *w, int64_t k, const vd *x, const vd *u, const vd *Qu, kinks *v) {
    bounds_at(m, w, k, x, v->low, v->high);
    for (int a = 0; a < NU; ++a) {
        vd kink = v->place[a] - u[a], near;
        v->rise[a] = Qu[a] + m->discount * v->up[a], v->fall[a] = Qu[a] - m->discount * v->down[a];
        v->stops[a] = vd_lt(v->fall[a], v->rise[a]) & vd_le(v->fall[a], V(0.0)) & vd_le(V(0.0), v->rise[a]);
        near = vd_select(vd_lt(kink, V(0.0)), v->rise[a], v->fall[a]);
        v->g[a] = vd_select(v->stops[a], near, vd_select(vd_lt(v->rise[a], V(0.0)), v->rise[a], v->fall[a]));
        /* A guessed plan may be out of its bounds. */
        v->low[a] = vd_min(v->low[a] - u[a], V(0.0)), v->high[a] = vd_max(v->high[a] - u[a], V(0.0));
        v->low[a] = vd_select(v->stops[a], vd_max(v->low[a], vd_min(kink, V(0.0))), v->low[a]);
        v->high[a] = vd_select(v->stops[a], vd_min(v->high[a], vd_max(kink, V(0.0))), v->high[a]);
    }
}

/* After the step d: which inputs follow the ones before, and the kinks of V at this stage. By the input before, V has the
 * slopes of Q where that takes the input along, and none where it does not: it may only push. */
static void after_step(const mpc_problem *m, const lanes *w, int64_t k, const vd *x, const vd *u, vd H[NU][NU], const vd *d,
                       const vl *is_free, kinks *v) {
    for (int a = 0; a < NU; ++a) {
        v->follows[a] = no_lanes();
        if (rate_place[a] < 0 || (!k && w->c.given)) continue;
        vd least = least_of(m, w, k, a), most = most_of(m, w, k, a), before = x[rate_place[a]], reached = u[a] + d[a];
        vd lowest = before - rate_down[a], highest = before + rate_up[a], kink = vd_abs(v->place[a] - u[a]), more = V(0.0);
        vd near_low = V(corner_of(rate_down[a])), near_high = V(corner_of(rate_up[a]));
        vl held = ~is_free[a], at_kink = held & v->stops[a] & vd_le(kink, vd_abs(d[a]));
        vl at_low = held & ~at_kink & vd_le(d[a], v->low[a]), at_high = held & ~at_kink & ~at_low & vd_le(v->high[a], d[a]);
        vl fallen = at_low & vd_lt(least, lowest), risen = at_high & vd_lt(highest, most);
        vl low_corner = (at_low | at_kink) & vd_le(vd_abs(lowest - least), near_low);
        vl high_corner = (at_high | at_kink) & ~low_corner & vd_le(vd_abs(highest - most), near_high);
        vl kink_at_low = at_kink & vd_lt(near_low, lowest - least) & vd_le(reached - lowest, near_low);
        vl kink_at_high = at_kink & vd_lt(near_high, most - highest) & vd_le(highest - reached, near_high);
        vl pushed_up = low_corner | kink_at_low, pushed_down = high_corner | kink_at_high;
        for (int b = 0; b < NU; ++b) more += H[a][b] * d[b];
        vd rise = v->rise[a] + more, fall = v->fall[a] + more, slope = V(0.0), above = V(0.0), below = V(0.0);
        v->follows[a] = fallen | risen;
        slope = vd_select(v->follows[a], v->g[a] + more, slope);
        above = vd_select(v->follows[a] & ~pushed_down, rise, above);
        above = vd_select(pushed_up, vd_max(rise, V(0.0)), above);
        below = vd_select(v->follows[a] & ~pushed_up, fall, below);
        below = vd_select(pushed_down, vd_min(fall, V(0.0)), below);
        v->up[a] = vd_max(above - slope, V(0.0)), v->down[a] = vd_max(slope - below, V(0.0));
        vd from_low = vd_select(low_corner, least, v->place[a]) + rate_down[a];
        vd from_high = vd_select(high_corner, most, v->place[a]) - rate_up[a];
        v->place[a] = vd_select(at_high | pushed_down, from_high, from_low);
    }
}

/* Column i of K: rows of inputs that follow, and what these add to those that are free. */
static void follow(vd H[NU][NU], const vl *is_free, const kinks *v, int i, vd *b) {
    for (int c = 0; c < NU; ++c) {
        if (rate_place[c] != i) continue;
        for (int a = 0; a < NU; ++a) b[a] -= vd_select(is_free[a] & v->follows[c], H[a][c], V(0.0));
        b[c] = vd_select(v->follows[c], V(1.0), b[c]);
    }
}
#endif
