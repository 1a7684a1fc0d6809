/* x and P are the estimate and the covariance of its error; acting holds the inputs that act in the step, dead time
 * past, then the present signals. Matrices that CasADi's expressions give are column by column, P is symmetric. */

static double clip(double v, double from, double to) { return v < from ? from : v > to ? to : v; }

static int all_finite(const double *v, int n) {
    for (int i = 0; i < n; ++i)
        if (!(fabs(v[i]) < INFINITY)) return 0;
    return 1;
}

/* Takes over what is finite; else what was known before stays. */
static void take(mpc_observer *o, const double *x, const double *P) {
    if (!all_finite(x, N_ESTIMATED) || !all_finite(P, N_ESTIMATED * N_ESTIMATED)) return;
    for (int i = 0; i < N_ESTIMATED; ++i) o->x[i] = x[i];
    for (int i = 0; i < N_ESTIMATED * N_ESTIMATED; ++i) o->P[i] = P[i];
}

/* A step later, before outputs: x- = f(x, u + d), P- = F P F' + Q. */
static void ahead(const double *theta, mpc_observer *o) {
    double given[N_ESTIMATED * (1 + N_ESTIMATED)], FP[N_ESTIMATED * N_ESTIMATED], P[N_ESTIMATED * N_ESTIMATED];
    const double *F = given + N_ESTIMATED;
    observed_ahead(o->x, o->acting, theta, given);
    if (!all_finite(given, N_ESTIMATED * (1 + N_ESTIMATED))) {
        for (int i = 0; i < N_ESTIMATED; ++i) o->P[i * (1 + N_ESTIMATED)] += missed[i] * missed[i];
        return;
    }
    for (int i = 0; i < N_ESTIMATED; ++i)
        for (int j = 0; j < N_ESTIMATED; ++j) {
            double sum = 0.0;
            for (int k = 0; k < N_ESTIMATED; ++k) sum += F[i + k * N_ESTIMATED] * o->P[k * N_ESTIMATED + j];
            FP[i * N_ESTIMATED + j] = sum;
        }
    for (int i = 0; i < N_ESTIMATED; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = i == j ? missed[i] * missed[i] : 0.0;
            for (int k = 0; k < N_ESTIMATED; ++k) sum += FP[i * N_ESTIMATED + k] * F[j + k * N_ESTIMATED];
            P[i * N_ESTIMATED + j] = P[j * N_ESTIMATED + i] = sum;
        }
    take(o, given, P);
}

/* With outputs, one after the other, as their errors are independent: K = P H' / (H P H' + r), x = x- + K (y - h(x-)),
 * P = (1 - K H) P (1 - K H)' + K r K'. All are linearised where the first one found the estimate. Before anything has
 * acted, those that depend on inputs are not there. */
static void corrected(const double *y, int acted, mpc_observer *o) {
    double given[MPC_N_OUTPUTS * (1 + N_ESTIMATED)], x[N_ESTIMATED], P[N_ESTIMATED * N_ESTIMATED];
    double Ph[N_ESTIMATED], K[N_ESTIMATED], hT[N_ESTIMATED];
    const double *H = given + MPC_N_OUTPUTS;
    observed_outputs(o->x, o->acting, given);
    for (int i = 0; i < N_ESTIMATED; ++i) x[i] = o->x[i];
    for (int i = 0; i < N_ESTIMATED * N_ESTIMATED; ++i) P[i] = o->P[i];
    for (int m = 0; m < MPC_N_OUTPUTS; ++m) {
        double S = noise[m] * noise[m], innovation = y[m] - given[m], rest = 0.0;
        if (!(fabs(y[m]) < INFINITY) || (of_inputs[m] && !acted)) continue;
        for (int i = 0; i < N_ESTIMATED; ++i) {
            Ph[i] = 0.0;
            for (int j = 0; j < N_ESTIMATED; ++j) Ph[i] += P[i * N_ESTIMATED + j] * H[m + j * MPC_N_OUTPUTS];
            S += H[m + i * MPC_N_OUTPUTS] * Ph[i];
            innovation -= H[m + i * MPC_N_OUTPUTS] * (x[i] - o->x[i]);
        }
        for (int i = 0; i < N_ESTIMATED; ++i) K[i] = Ph[i] / S, x[i] += K[i] * innovation;
        for (int i = 0; i < N_ESTIMATED; ++i) rest += H[m + i * MPC_N_OUTPUTS] * K[i];
        for (int i = 0; i < N_ESTIMATED; ++i) hT[i] = Ph[i] * (1.0 - rest); /* h' (1 - K h')' P, transposed */
        for (int i = 0; i < N_ESTIMATED; ++i)
            for (int j = 0; j <= i; ++j) {
                double kept = P[i * N_ESTIMATED + j] - K[i] * Ph[j] - hT[i] * K[j] + K[i] * noise[m] * noise[m] * K[j];
                P[i * N_ESTIMATED + j] = P[j * N_ESTIMATED + i] = kept;
            }
    }
    take(o, x, P);
}

void mpc_observer_reset(mpc_observer *observer) { observer->begun = 0; }

int mpc_observer_step(
    const mpc_parameters *parameters, mpc_observer *o, mpc_state *state, const double measured[MPC_N_MEASURED],
    double u[MPC_NU]
) {
    double every[MPC_NX + MPC_NU], d[MPC_NU];
    int answer, acted = o->begun;
    if (acted) {
        ahead((const double *)parameters, o);
    } else {
        for (int i = 0; i < N_ESTIMATED; ++i) o->x[i] = begin[i];
        for (int i = 0; i < N_ESTIMATED * N_ESTIMATED; ++i) o->P[i] = 0.0;
        for (int i = 0; i < N_ESTIMATED; ++i) o->P[i * (1 + N_ESTIMATED)] = begin_spread[i] * begin_spread[i];
        for (int i = 0; i < N_ACTING; ++i) o->acting[i] = 0.0;
        o->begun = 1;
    }
    corrected(measured, acted, o);
    /* Inputs act together with the disturbances of now: what the MPC plans is to act, what is applied is less. */
    for (int a = 0; a < MPC_NU; ++a) d[a] = a < MPC_N_DISTURBANCES ? o->x[N_ESTIMATED - MPC_N_DISTURBANCES + a] : 0.0;
    for (int i = 0; i < MPC_NY; ++i)
        every[i] = i < MPC_N_STATES ? o->x[i] : measured[MPC_N_OUTPUTS + i - MPC_N_STATES];
    for (int i = MPC_NY; i < MPC_NX; ++i) {
        every[i] = state->past[i - MPC_NY];
        state->past[i - MPC_NY] += d[input_of[i - MPC_NY]];
    }
    answer = mpc_step(parameters, state, every, u);
    for (int a = 0; a < MPC_NU; ++a) every[MPC_NX + a] = u[a] = clip(u[a] - d[a], low[a], high[a]);
    for (int i = 0; i < MPC_NX - MPC_NY; ++i) state->past[i] = every[MPC_NY + sources[i]];
    for (int i = 0; i < N_ACTING; ++i) o->acting[i] = every[acting[i]];
    return answer;
}
