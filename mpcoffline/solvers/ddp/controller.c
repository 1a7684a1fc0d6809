/* The controller: one problem, warm from the plan of the step before, cold from the best of many input sequences. */

/* Iterates from w->x, w->u; J = INFINITY says that w->x need not obey the model. Returns one of the states above. */
static int solve(const mpc_problem *m, lanes *w) {
    w->mu = w->alpha = 0.0;
    for (int64_t k = 1; k <= m->max_iterations; ++k) {
        vl converged, moved, stalled;
        iterate(m, w, -1, &converged, &moved, &stalled);
        if (k == m->max_iterations && !stalled) converged |= acceptable(m, w);
        if (!converged && !stalled) continue;
        double zero = w->J - w->J; /* NaN as soon as something is not finite */
        for (int i = 0; i < MPC_HORIZON * NU; ++i) zero += w->u[i] - w->u[i];
        for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) zero += w->x[i] - w->x[i];
        return zero != 0.0 ? NOT_FINITE : converged ? CONVERGED : STALLED;
    }
    return w->J < INFINITY && w->J > -INFINITY ? ITERATION_LIMIT : NOT_FINITE;
}

static double candidate(int c, int k, int a) { return candidates[(c * SEGMENTS + k / SEGMENT) * NU + a]; }

static void keep(mpc_state *state, const lanes *w) {
    for (int i = 0; i < MPC_HORIZON * NU; ++i) state->u[i] = w->u[i];
    for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) state->x[i] = w->x[i];
}

/* From one of the candidates, for a few iterations. */
static void start(const mpc_problem *m, lanes *w, int c) {
    mpc_problem race = *m;
    if (race.max_iterations > RACE_ITERATIONS) race.max_iterations = RACE_ITERATIONS;
    for (int k = 0; k < MPC_HORIZON; ++k)
        for (int a = 0; a < NU; ++a) w->u[k * NU + a] = clip(candidate(c, k, a), m->low[a], m->high[a]);
    w->J = rollout_open(m, w, w->x, w->u);
    solve(&race, w);
    if (!(w->J < INFINITY)) w->J = INFINITY;
}

/* Solves from MPC_STARTS starts, each the cheapest of its share of the candidates: a few iterations each, the best go
 * on (they are run again, which needs less memory than keeping all), the best solution is kept. Returns whether there
 * is one. */
static int solve_cold(const mpc_problem *m, mpc_state *state, lanes *w) {
    double J[N_CANDIDATES], raced[MPC_STARTS], best = INFINITY;
    int cheapest[MPC_STARTS], best_converged = 0;
    int64_t chosen[FINALISTS(MPC_STARTS)];
    for (int c = 0; c < N_CANDIDATES; ++c) {
        for (int k = 0; k < MPC_HORIZON; ++k)
            for (int a = 0; a < NU; ++a) w->u[k * NU + a] = candidate(c, k, a);
        J[c] = rollout_open(m, w, w->x, w->u);
        if (!(J[c] < INFINITY)) J[c] = INFINITY;
    }
    for (int l = 0; l < MPC_STARTS; ++l) {
        cheapest[l] = l * N_CANDIDATES / MPC_STARTS;
        for (int c = cheapest[l]; c < (l + 1) * N_CANDIDATES / MPC_STARTS; ++c)
            if (J[c] < J[cheapest[l]]) cheapest[l] = c;
        start(m, w, cheapest[l]);
        raced[l] = w->J;
    }
    choose_finalists(raced, MPC_STARTS, chosen);
    for (int l = 0; l < FINALISTS(MPC_STARTS); ++l) {
        start(m, w, cheapest[chosen[l]]);
        int converged = solve(m, w) == CONVERGED;
        /* A converged solution that is as good as the best goes before one that is not. */
        double slack = BEATEN * (1.0 + fabs(best));
        int closer = converged && !best_converged && w->J < best + slack;
        if (closer || w->J < best - (converged == best_converged ? 0.0 : slack) || !(best < INFINITY)) {
            best = w->J;
            best_converged = converged;
            keep(state, w);
        }
    }
    return best_converged;
}

void mpc_reset(mpc_state *state) { state->has_plan = 0; }

int mpc_step(const mpc_parameters *parameters, mpc_state *state, const double y[MPC_NX], double u[MPC_NU]) {
    const mpc_problem problem = {MPC_HORIZON, DISCOUNT, low, high, MPC_MAX_ITERATIONS, TOLERANCE};
    const double *theta = (const double *)parameters;
    lanes w;
    int solved = 0;
    w.x = state->work_x, w.u = state->work_u, w.x_new = state->work_x_new, w.u_new = state->work_u_new;
    w.k = state->work_k, w.K = state->work_K;
    for (int i = 0; i < NP; ++i) w.p[i] = theta[i];
    gen_prepare(w.p, w.p + NP);
    for (int i = 0; i < NX; ++i) w.s[i] = y[i];
    for (int a = 0; a < NU; ++a) w.low0[a] = low[a], w.high0[a] = high[a];
    if (state->has_plan) {
        for (int i = 0; i < MPC_HORIZON * NU; ++i) w.u[i] = clip(state->u[i], low[i % NU], high[i % NU]);
        for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) w.x[i] = i < NX ? y[i] : state->x[i];
        w.J = INFINITY;
        int status = solve(&problem, &w);
        solved = status == CONVERGED;
        if (solved) keep(state, &w);
        if (status == STALLED || status == NOT_FINITE) { /* the plan led nowhere; it is kept if a cold start does too */
            for (int i = 0; i < MPC_HORIZON * NU; ++i) state->old_u[i] = state->u[i];
            for (int i = 0; i < (MPC_HORIZON + 1) * NX; ++i) state->old_x[i] = state->x[i];
            solved = solve_cold(&problem, state, &w);
            for (int i = 0; i < MPC_HORIZON * NU && !solved; ++i) state->u[i] = state->old_u[i];
            for (int i = 0; i < (MPC_HORIZON + 1) * NX && !solved; ++i) state->x[i] = state->old_x[i];
        }
    } else {
        solved = state->has_plan = solve_cold(&problem, state, &w);
        for (int a = 0; a < NU && !solved; ++a) state->u[a] = 0.0;
    }
    for (int a = 0; a < NU; ++a) u[a] = clip(state->u[a], low[a], high[a]);
    /* The plan of the next step, its last input held. */
    for (int i = 0; i < (MPC_HORIZON - 1) * NU; ++i) state->u[i] = state->u[i + NU];
    for (int i = 0; i < MPC_HORIZON * NX; ++i) state->x[i] = state->x[i + NX];
    return solved ? 0 : 1;
}
