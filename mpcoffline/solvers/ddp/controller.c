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
        if (k == m->max_iterations && !stalled) converged |= acceptable(m, w);
        if (!converged && !stalled) continue;
        return !is_finite(w) ? NOT_FINITE : converged ? CONVERGED : STALLED;
    }
    return is_finite(w) ? ITERATION_LIMIT : NOT_FINITE;
}

static double candidate(int c, int k, int a) { return candidates[(c * SEGMENTS + k / SEGMENT) * NU + a]; }

static void keep(double *x, double *u, const double *from_x, const double *from_u) {
    for (int i = 0; i < MPC_HORIZON * NU; ++i) u[i] = from_u[i];
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) x[i] = from_x[i];
}

/* From one of the candidates, for a few iterations. */
static void start(const mpc_problem *m, lanes *w, int c) {
    mpc_problem race = *m;
    if (race.max_iterations > RACE_ITERATIONS) race.max_iterations = RACE_ITERATIONS;
    for (int k = 0; k < MPC_HORIZON; ++k)
        for (int a = 0; a < NU; ++a) w->u[k * NU + a] = clip(candidate(c, k, a), m->low[a], m->high[a]);
    w->J = rollout_open(m, w, w->x, w->u, &w->size);
    solve(&race, w);
    if (!(w->J < INFINITY)) w->J = INFINITY;
}

/* Solves from MPC_STARTS starts, each the cheapest of its share of the candidates: a few iterations each, the best go
 * on (they are run again, which needs less memory than keeping all), the best plan is kept, and its cost is w->J. Returns
 * its state; NOT_FINITE if there is none. */
static int solve_cold(const mpc_problem *m, mpc_state *state, lanes *w) {
    double J[N_CANDIDATES], raced[MPC_STARTS], best = INFINITY;
    int cheapest[MPC_STARTS], best_status = NOT_FINITE;
    int64_t chosen[FINALISTS(MPC_STARTS)];
    for (int c = 0; c < N_CANDIDATES; ++c) {
        for (int k = 0; k < MPC_HORIZON; ++k)
            for (int a = 0; a < NU; ++a) w->u[k * NU + a] = candidate(c, k, a);
        J[c] = rollout_open(m, w, w->x, w->u, &w->size);
        if (!(J[c] < INFINITY)) J[c] = INFINITY;
    }
    for (int l = 0; l < MPC_STARTS; ++l) {
        cheapest[l] = (int)start_of(l, MPC_STARTS, J, N_CANDIDATES);
        start(m, w, cheapest[l]);
        raced[l] = w->J;
    }
    choose_finalists(raced, MPC_STARTS, chosen);
    for (int l = 0; l < FINALISTS(MPC_STARTS); ++l) {
        start(m, w, cheapest[chosen[l]]);
        int status = solve(m, w);
        if (status == NOT_FINITE) continue;
        if (goes_before(w->J, status == CONVERGED, best, best_status == CONVERGED)) {
            best = w->J;
            best_status = status;
            keep(state->x, state->u, w->x, w->u);
        }
    }
    w->J = best;
    return best_status;
}

void mpc_reset(mpc_state *state) {
    state->has_plan = 0;
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
    w->J = w->size = INFINITY;
    int status = solve(m, w), found = status != NOT_FINITE;
    double J = found ? w->J : INFINITY;
    if (status == CONVERGED) {
        keep(state->x, state->u, w->x, w->u);
        return 0;
    }
    if (found) keep(state->old_x, state->old_u, w->x, w->u);
    else keep(state->old_x, state->old_u, state->x, state->u);
    status = solve_cold(m, state, w);
    if (status == CONVERGED) return 0;
    if (status != NOT_FINITE && w->J < J) return 1;
    keep(state->x, state->u, state->old_x, state->old_u);
    return found ? 1 : 2;
}

int mpc_step(const mpc_parameters *parameters, mpc_state *state, const double y[MPC_NY], double u[MPC_NU]) {
    const mpc_problem problem = {MPC_HORIZON, DISCOUNT, low, high, unit, MPC_MAX_ITERATIONS, TOLERANCE};
    const double *theta = (const double *)parameters;
    lanes w;
    int answer;
    w.x = state->work_x, w.u = state->work_u, w.x_new = state->work_x_new, w.u_new = state->work_u_new;
    w.k = state->work_k, w.K = state->work_K;
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
    /* The plan of the next step, its last input held. */
    for (int i = 0; i < (MPC_HORIZON - 1) * NU; ++i) state->u[i] = state->u[i + NU];
    for (int i = 0; i < MPC_HORIZON * NX; ++i) state->x[i] = state->x[i + NX];
    return answer;
}
