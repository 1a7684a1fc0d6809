#if LIMITS
#define SAME_PLACE(size) typedef char same_place[(size) == MPC_SURVEY ? 1 : -1]
SAME_PLACE(SURVEY_SIZE); /* of the header */
#endif

/* The controller: one problem, warm from the plan of the step before, cold from the best of many input sequences. */

static int is_finite(const lanes *w) {
    double zero = w->J - w->J; /* NaN as soon as something is not finite */
    for (int i = 0; i < MPC_HORIZON * NU; ++i) zero += w->u[i] - w->u[i];
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) zero += w->x[i] - w->x[i];
    return zero == 0.0;
}

/* Iterates from w->x, w->u; J = INFINITY says that w->x need not obey the model. Returns one of the states above. */
static int solve(const mpc_problem *m, lanes *w) {
    w->mu = w->alpha = 0.0;
    for (int64_t k = 1; k <= m->max_iterations; ++k) {
        vl converged, moved, stalled;
        iterate(m, w, -1, &converged, &moved, &stalled);
#if LIMITS
        if (!m->race && tighten(m, w, &converged, &stalled)) return is_finite(w) ? INFEASIBLE : NOT_FINITE;
        if (k == m->max_iterations && !stalled && acceptable(m, w)) {
            vd off[LIMITS], overpaid = distances(m, w, off);
            converged |= m->race || is_near(w, off, overpaid);
        }
#else
        if (k == m->max_iterations && !stalled) converged |= acceptable(m, w);
#endif
        if (!converged && !stalled) continue;
        return !is_finite(w) ? NOT_FINITE : converged ? CONVERGED : STALLED;
    }
    return is_finite(w) ? ITERATION_LIMIT : NOT_FINITE;
}

/* The status of a plan that is handed out: J becomes its true cost, and a solution keeps its limits, whatever the
 * algorithm says. */
static int settle(const mpc_problem *m, lanes *w, int status) {
#if LIMITS
    vd worst, now, cost;
    appraise(m, w, &cost, &w->c.violation, &worst, &now);
    if (status != NOT_FINITE) w->J = cost;
    if (status == CONVERGED && !(w->c.violation <= FEASIBLE)) return INFEASIBLE;
#else
    (void)m, (void)w;
#endif
    return status;
}

#if LIMITS
/* Multipliers, weights and scales as they are kept from step to step; from a plan, or zero and what the candidates say. */
static void load_limits(const mpc_problem *m, mpc_state *state, lanes *w, double tolerance) {
    const double *from = state->limits, *rho = from + (MPC_HORIZON + 1) * LIMITS;
    for (int i = 0; i < (MPC_HORIZON + 1) * LIMITS; ++i) w->c.multiplier[i] = from[i];
    for (int j = 0; j < LIMITS; ++j) {
        double first = rho[LIMITS + j];
        w->c.rho[j] = relaxed(rho[j], first);
        w->c.first_rho[j] = first, w->c.scale[j] = rho[2 * LIMITS + j], w->c.before[j] = INFINITY, w->c.stuck[j] = 0.0;
    }
    w->c.tolerance = tolerance > m->tolerance ? tolerance : m->tolerance;
    w->c.looser = sqrt(w->c.tolerance / m->tolerance);
    w->c.inner = w->c.dominated = 0.0;
    weigh(&w->c);
}

static void store_limits(const lanes *w, double *to) {
    double *rho = to + (MPC_HORIZON + 1) * LIMITS;
    for (int i = 0; i < (MPC_HORIZON + 1) * LIMITS; ++i) to[i] = w->c.multiplier[i];
    for (int j = 0; j < END_FIRST; ++j) to[MPC_HORIZON * LIMITS + j] = w->c.multiplier[(MPC_HORIZON - 1) * LIMITS + j];
    for (int j = 0; j < LIMITS; ++j)
        rho[j] = w->c.rho[j], rho[LIMITS + j] = w->c.first_rho[j], rho[2 * LIMITS + j] = w->c.scale[j];
}

static double candidate(int c, int k, int a);

static void first_limits(const mpc_problem *m, mpc_state *state, lanes *w) {
    double *rho = state->limits + (MPC_HORIZON + 1) * LIMITS;
    survey s = survey_in(state->work_survey);
    for (int i = 0; i < (MPC_HORIZON + 1) * LIMITS; ++i) state->limits[i] = 0.0;
    for (int j = 0; j < 3 * LIMITS; ++j) rho[j] = 1.0;
    load_limits(m, state, w, FIRST_TOLERANCE);
    for (int c = 0; c < N_CANDIDATES; ++c) {
        for (int k = 0; k < MPC_HORIZON; ++k)
            for (int a = 0; a < NU; ++a) w->u[k * NU + a] = candidate(c, k, a);
        rollout_open(m, w, w->x, w->u, all_lanes(), &w->size);
        note(m, w, &s);
    }
    conclude(m, &s, rho + LIMITS, rho + 2 * LIMITS);
    for (int j = 0; j < LIMITS; ++j) rho[j] = rho[LIMITS + j];
}
#endif

static double candidate(int c, int k, int a) { return candidates[(c * SEGMENTS + k / SEGMENT) * NU + a]; }

static void keep(double *x, double *u, const double *from_x, const double *from_u) {
    for (int i = 0; i < MPC_HORIZON * NU; ++i) u[i] = from_u[i];
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) x[i] = from_x[i];
}

/* The states and the cost of the inputs w->u. */
static void roll_out(const mpc_problem *m, lanes *w) {
    w->J = rollout_open(m, w, w->x, w->u, all_lanes(), &w->size);
#if LIMITS
    for (int i = 0; i < (MPC_HORIZON + 1) * LIMITS; ++i) w->c.h[i] = w->c.h_new[i];
    w->c.base = w->c.base_new, w->c.base_size = w->c.base_size_new;
#endif
}

/* From one of the candidates, for a few iterations. */
static void start(const mpc_problem *m, mpc_state *state, lanes *w, int c) {
    (void)state;
    mpc_problem race = *m;
    if (race.max_iterations > RACE_ITERATIONS) race.max_iterations = RACE_ITERATIONS;
    for (int k = 0; k < MPC_HORIZON; ++k)
        for (int a = 0; a < NU; ++a) w->u[k * NU + a] = clip(candidate(c, k, a), m->low[a], m->high[a]);
#if LIMITS
    race.race = 1;
    load_limits(m, state, w, FIRST_TOLERANCE);
#endif
    roll_out(m, w);
    solve(&race, w);
    if (!(w->J < INFINITY)) w->J = INFINITY;
}

/* A plan that stays where the plant is, and need not obey the model. */
static void stay(const mpc_problem *m, lanes *w) {
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) w->x[i] = w->s[i % NX];
    for (int i = 0; i < MPC_HORIZON * NU; ++i) w->u[i] = m->rest[i % NU];
    w->J = w->size = INFINITY;
}

/* Solves from MPC_STARTS starts, each the cheapest of its share of the candidates: a few iterations each, the best go
 * on (they are run again, which needs less memory than keeping all), beside a plan that stays, the best plan is kept, and
 * its cost is w->J. Returns its state; NOT_FINITE if there is none. */
static int solve_cold(const mpc_problem *m, mpc_state *state, lanes *w) {
    double J[N_CANDIDATES], raced[MPC_STARTS], best = INFINITY;
    int cheapest[MPC_STARTS], best_status = NOT_FINITE;
    int64_t chosen[FINALISTS(MPC_STARTS)];
#if LIMITS
    double violation = INFINITY;
    first_limits(m, state, w);
    load_limits(m, state, w, FIRST_TOLERANCE);
    state->has_limits = 0; /* the last ones that are kept are those of the best plan */
#endif
    for (int c = 0; c < N_CANDIDATES; ++c) {
        for (int k = 0; k < MPC_HORIZON; ++k)
            for (int a = 0; a < NU; ++a) w->u[k * NU + a] = candidate(c, k, a);
        J[c] = rollout_open(m, w, w->x, w->u, all_lanes(), &w->size);
        if (!(J[c] < INFINITY)) J[c] = INFINITY;
    }
    for (int l = 0; l < MPC_STARTS; ++l) {
        cheapest[l] = (int)start_of(l, MPC_STARTS, J, N_CANDIDATES);
        start(m, state, w, cheapest[l]);
        raced[l] = w->J;
    }
    choose_finalists(raced, MPC_STARTS, chosen);
    for (int l = 0; l < FINALISTS(MPC_STARTS) + (MPC_STARTS > 1); ++l) {
        if (l < FINALISTS(MPC_STARTS)) start(m, state, w, cheapest[chosen[l]]);
        else stay(m, w);
#if LIMITS
        load_limits(m, state, w, FIRST_TOLERANCE);
#endif
        int status = settle(m, w, solve(m, w));
        if (status == NOT_FINITE) continue;
#if LIMITS
        int first = best_status == NOT_FINITE ? 0 : keeps_better(w->c.violation, violation);
        if (first < 0) continue;
        if (first > 0) best = INFINITY;
#endif
        if (goes_before(w->J, status == CONVERGED, best, best_status == CONVERGED)) {
            best = w->J;
            best_status = status;
            keep(state->x, state->u, w->x, w->u);
#if LIMITS
            violation = w->c.violation;
            store_limits(w, state->work_limits);
#endif
        }
    }
    w->J = best;
#if LIMITS
    w->c.violation = violation;
    for (int i = 0; i < MULTIPLIER_ROWS(MPC_HORIZON) * LIMITS; ++i) state->limits[i] = state->work_limits[i];
    state->has_limits = best_status == CONVERGED;
#endif
    return best_status;
}

void mpc_reset(mpc_state *state) {
    state->has_plan = 0;
#if LIMITS
    state->has_limits = 0;
#endif
    for (int i = 0; i < MPC_NX - MPC_NY; ++i) state->past[i] = usual[i];
}

/* The past inputs of the next step: each entry takes over an earlier one, or the input that is applied now. */
static void remember(mpc_state *state, const double *u) {
    for (int i = MPC_NX - MPC_NY - 1; i >= 0; --i)
        state->past[i] = sources[i] < MPC_NX - MPC_NY ? state->past[sources[i]] : u[sources[i] - (MPC_NX - MPC_NY)];
}

/* From the plan of the step before; where that is not solved, from all starts. The plan of the state becomes the solution,
 * else the better of the two plans found, else it stays the one before. Returns what mpc_step does. */
static int improve(const mpc_problem *m, mpc_state *state, lanes *w) {
    for (int i = 0; i < MPC_HORIZON * NU; ++i) w->u[i] = clip(state->u[i], low[i % NU], high[i % NU]);
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) w->x[i] = i < NX ? w->s[i] : state->x[i];
#if LIMITS
    int was_lost = !state->has_limits;
    if (was_lost) {
        keep(state->old_x, state->old_u, w->x, w->u);
        first_limits(m, state, w);
        keep(w->x, w->u, state->old_x, state->old_u);
    }
    load_limits(m, state, w, WARM_TOLERANCE);
#endif
    w->J = w->size = INFINITY;
    int status = settle(m, w, solve(m, w)), found = status != NOT_FINITE;
    double J = found ? w->J : INFINITY;
    if (status == CONVERGED) {
        keep(state->x, state->u, w->x, w->u);
#if LIMITS
        store_limits(w, state->limits);
        state->has_limits = 1;
#endif
        return 0;
    }
#if LIMITS
    double violation = w->c.violation;
    if (was_lost && status == INFEASIBLE) { /* its plan was the best from all starts */
        keep(state->x, state->u, w->x, w->u);
        return 1;
    }
#endif
    if (found) keep(state->old_x, state->old_u, w->x, w->u);
    else keep(state->old_x, state->old_u, state->x, state->u);
    status = solve_cold(m, state, w);
    if (status == CONVERGED) return 0;
#if LIMITS
    int first = found && status != NOT_FINITE ? keeps_better(w->c.violation, violation) : 0;
    if (first > 0) return 1;
    if (first < 0) w->J = INFINITY;
#endif
    if (status != NOT_FINITE && w->J < J) return 1;
    keep(state->x, state->u, state->old_x, state->old_u);
    return found ? 1 : 2;
}

/* Where the plan can wait for a step: at its end, unless before it rests, or is slower than there and pays less. */
static int pause_of(const double *x, const double *u, const double *p) {
    double scale[NX] = {0.0}, moved = 0.0, least = INFINITY;
    int slowest = MPC_HORIZON;
    for (int i = 0; i < MPC_HORIZON * NX; ++i) {
        double step = x[i + NX] - x[i];
        if (scale[i % NX] < step * step) scale[i % NX] = step * step;
    }
    for (int i = 0; i < NX; ++i) scale[i] = 1.0 / scale[i] < INFINITY ? 1.0 / scale[i] : 0.0;
    for (int k = 0; k < MPC_HORIZON; ++k) {
        double before = moved;
        moved = 0.0;
        for (int i = k * NX; i < (k + 1) * NX; ++i) moved += (x[i + NX] - x[i]) * (x[i + NX] - x[i]) * scale[i % NX];
        if (k > 0 && before + moved < least) least = before + moved, slowest = k;
    }
    if (MPC_HORIZON < 3 || !(least < 2.0 * 0.25 * moved)) return MPC_HORIZON;
    if (!(least < 2.0 * 0.01 * NX)) {
        double there[NX + 1], at_end[NX + 1];
        gen_step(x + slowest * NX, u + slowest * NU, p, there);
        gen_step(x + MPC_HORIZON * NX, u + (MPC_HORIZON - 1) * NU, p, at_end);
        if (!(there[NX] < at_end[NX])) return MPC_HORIZON;
    }
    return slowest;
}

int mpc_step(const mpc_parameters *parameters, mpc_state *state, const double y[MPC_NY], double u[MPC_NU]) {
#if LIMITS
    const mpc_problem problem = {MPC_HORIZON, DISCOUNT, low, high, unit, rest, MPC_MAX_ITERATIONS, TOLERANCE, 0};
#else
    const mpc_problem problem = {MPC_HORIZON, DISCOUNT, low, high, unit, rest, MPC_MAX_ITERATIONS, TOLERANCE};
#endif
    const double *theta = (const double *)parameters;
    lanes w;
    int answer;
    w.x = state->work_x, w.u = state->work_u, w.x_new = state->work_x_new, w.u_new = state->work_u_new;
    w.k = state->work_k, w.K = state->work_K;
#if LIMITS
    w.c.h = state->work_h, w.c.h_new = state->work_h_new, w.c.multiplier = state->work_multiplier;
    w.c.asked = 0, w.c.given = 0;
#endif
    for (int i = 0; i < NP; ++i) w.p[i] = theta[i];
    gen_prepare(w.p, w.p + NP);
    for (int i = 0; i < NX; ++i) w.s[i] = i < MPC_NY ? y[i] : state->past[i - MPC_NY];
    for (int a = 0; a < NU; ++a) w.low0[a] = low[a], w.high0[a] = high[a];
    if (state->has_plan) {
        answer = improve(&problem, state, &w);
    } else {
        int status = solve_cold(&problem, state, &w);
        answer = status == CONVERGED ? 0 : status == NOT_FINITE ? 3 : 1;
        state->has_plan = answer < 3;
        for (int a = 0; a < NU && answer == 3; ++a) state->u[a] = 0.0;
    }
    for (int a = 0; a < NU; ++a) u[a] = clip(state->u[a], low[a], high[a]);
    remember(state, u);
    /* The plan of the next step. */
    int pause = pause_of(state->x, state->u, w.p);
    for (int i = 0; i < (pause < MPC_HORIZON ? pause : MPC_HORIZON - 1) * NU; ++i) state->u[i] = state->u[i + NU];
    for (int i = 0; i < pause * NX; ++i) state->x[i] = state->x[i + NX];
#if LIMITS
    for (int i = 0; i < pause * LIMITS; ++i) state->limits[i] = state->limits[i + LIMITS];
#endif
    return answer;
}
