/* Batches of problems: LANES of them in lock step through the iterations of core.c. */
#include <stdlib.h>
#include <string.h>

static void lanes_free(lanes *w) {
    if (!w) return;
    free(w->x); free(w->u); free(w->x_new); free(w->u_new); free(w->k); free(w->K);
    free(w);
}

static lanes *lanes_new(int64_t N) {
    lanes *w = NULL;
    if (posix_memalign((void **)&w, 64, sizeof(lanes))) return NULL;
    memset(w, 0, sizeof(lanes));
    size_t sizes[6] = {(N + 1) * NX, N * NU, (N + 1) * NX, N * NU, N * NU, N * NU * NX};
    vd **fields[6] = {&w->x, &w->u, &w->x_new, &w->u_new, &w->k, &w->K};
    for (int i = 0; i < 6; ++i) {
        void *memory;
        if (posix_memalign(&memory, 64, sizes[i] * sizeof(vd))) {
            lanes_free(w);
            return NULL;
        }
        *fields[i] = memset(memory, 0, sizes[i] * sizeof(vd));
    }
    return w;
}

/* What x_guess, u_guess are: a plan whose states need not obey the model, inputs alone, or a rollout that costs J. */
enum { PLAN = 0, INPUTS = 1, ROLLOUT = 2 };

/* One problem per lane; lane i works on problem queue[i] or on nothing (-1). */
typedef struct {
    int64_t n;
    const double *x0, *theta, *u0; /* (n, NX), (n, NP) or (NP), (n, NU) or NULL */
    int64_t theta_stride;          /* NP, or 0: one theta for all */
    double *x, *u, *J, *predicted; /* solution: (n, N+1, NX), (n, N, NU), (n), (n) */
    double *size;                  /* (n), or NULL: of the costs of a ROLLOUT */
    int64_t *iterations, *status;  /* (n) */
    int guess;                       /* PLAN, INPUTS, or ROLLOUT */
    const double *x_guess, *u_guess; /* as x, u, and may be these */
    int rivals;                      /* these are starts of one problem, of which only the best solution matters */
} mpc_batch;

/* One theta for all lanes. */
static void load_theta(lanes *w, const double *theta) {
    for (int j = 0; j < NP; ++j) w->p[j] = V(theta[j]);
    gen_prepare(w->p, w->p + NP);
}

static void load_lane(const mpc_problem *m, const mpc_batch *b, lanes *w, int lane, int64_t i) {
    int64_t N = m->horizon;
    for (int j = 0; j < b->theta_stride; ++j) w->p[j][lane] = b->theta[i * b->theta_stride + j];
    for (int j = 0; j < NX; ++j) w->s[j][lane] = b->x0[i * NX + j];
    for (int a = 0; a < NU; ++a) {
        w->low0[a][lane] = b->u0 ? b->u0[i * NU + a] : m->low[a];
        w->high0[a][lane] = b->u0 ? b->u0[i * NU + a] : m->high[a];
    }
    for (int a = 0; a < NU; ++a) {
        double low = m->low[a], high = m->high[a];
        for (int64_t k = a; k < N * NU; k += NU) {
            double v = b->u_guess[i * N * NU + k];
            w->u[k][lane] = v < low ? low : v > high ? high : v;
        }
        if (b->u0) w->u[a][lane] = b->u0[i * NU + a];
    }
    if (b->guess != INPUTS)
        for (int64_t k = 0; k < (N + 1) * NX; ++k) w->x[k][lane] = b->x_guess[i * (N + 1) * NX + k];
    for (int j = 0; j < NX; ++j) w->x[j][lane] = w->s[j][lane];
    w->J[lane] = b->guess == ROLLOUT ? b->J[i] : INFINITY;
    w->size[lane] = b->guess == ROLLOUT ? b->size[i] : INFINITY;
    w->mu[lane] = w->alpha[lane] = 0.0;
}

/* Whether no number has the exponent of infinities and NaNs; in integers, which compilers vectorise. */
static int is_finite(const double *v, int64_t n) {
    const uint64_t exponent = 0x7ff0000000000000u;
    uint64_t found = 0;
    for (int64_t k = 0; k < n; ++k) {
        uint64_t bits;
        memcpy(&bits, v + k, sizeof bits);
        found |= (bits & exponent) == exponent;
    }
    return !found;
}

static void store_lane(const mpc_problem *m, const mpc_batch *b, const lanes *w, int lane, int64_t i, int64_t status,
                       int64_t iterations) {
    int64_t n_u = m->horizon * NU, n_x = (m->horizon + 1) * NX;
    double *u = b->u + i * n_u, *x = b->x + i * n_x;
    for (int64_t k = 0; k < n_u; ++k) u[k] = w->u[k][lane];
    for (int64_t k = 0; k < n_x; ++k) x[k] = w->x[k][lane];
    b->J[i] = w->J[lane];
    if (b->size) b->size[i] = w->size[lane];
    int finite = is_finite(b->J + i, 1) && is_finite(u, n_u) && is_finite(x, n_x);
    b->predicted[i] = w->predicted[lane];
    b->status[i] = finite ? status : NOT_FINITE;
    b->iterations[i] = iterations;
}

/* Whether what a start has reached and what it promises are no better than a solution of the same problem. */
static int is_beaten(const lanes *w, int lane, double best) {
    return best < INFINITY && !(w->J[lane] - 2.0 * w->predicted[lane] < best - BEATEN * fabs(best));
}

/* Solves problems first, first + stride, ... of the batch; a lane that finishes takes the next one. */
static void solve_range(const mpc_problem *m, const mpc_batch *b, lanes *w, int64_t first, int64_t stride) {
    int64_t problem[LANES], count[LANES], next = first;
    int fresh_any, busy;
    double best = INFINITY;
    if (!b->theta_stride) load_theta(w, b->theta);
    for (int l = 0; l < LANES; ++l) {
        problem[l] = -1;
        if (first < b->n) load_lane(m, b, w, l, first); /* lanes that get nothing to do repeat this one, ignored */
    }
    for (;;) {
        vl fresh = no_lanes();
        fresh_any = busy = 0;
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0 && next < b->n) {
                load_lane(m, b, w, l, problem[l] = next);
                next += stride;
                count[l] = 0;
                fresh[l] = -1;
                fresh_any = 1;
            }
            busy |= problem[l] >= 0;
        }
        if (!busy) break;
        if (fresh_any && b->theta_stride) gen_prepare(w->p, w->p + NP);
        if (fresh_any && b->guess == INPUTS) {
            vd size, J = rollout_open(m, w, w->x_new, w->u, &size);
            for (int64_t k = 0; k < (m->horizon + 1) * NX; ++k) w->x[k] = vd_select(fresh, w->x_new[k], w->x[k]);
            w->J = vd_select(fresh, J, w->J);
            w->size = vd_select(fresh, size, w->size);
        }
        vl wanted = no_lanes(), converged, moved, stalled;
        for (int l = 0; l < LANES; ++l) wanted[l] = -(problem[l] >= 0);
        iterate(m, w, wanted, &converged, &moved, &stalled);
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0) continue;
            int64_t status = converged[l] ? CONVERGED : stalled[l] ? STALLED : RUNNING;
            ++count[l];
            if (status == RUNNING && count[l] >= m->max_iterations)
                status = acceptable(m, w)[l] ? CONVERGED : ITERATION_LIMIT;
            if (b->rivals && status == CONVERGED && w->J[l] < best) best = w->J[l];
            if (b->rivals && status == RUNNING && is_beaten(w, l, best)) status = ITERATION_LIMIT;
            if (status != RUNNING) {
                store_lane(m, b, w, l, problem[l], status, count[l]);
                problem[l] = -1;
            }
        }
    }
}

/* Open-loop costs of n_candidates input sequences (a multiple of LANES) from one state; J (n_candidates). */
static void candidate_costs(const mpc_problem *m, lanes *w, const double *x0, const double *theta, const double *u0,
                            const double *candidates, int64_t n_candidates, double *J) {
    int64_t size = m->horizon * NU;
    load_theta(w, theta);
    for (int j = 0; j < NX; ++j) w->s[j] = V(x0[j]);
    for (int64_t c = 0; c < n_candidates; c += LANES) {
        for (int l = 0; l < LANES; ++l)
            for (int64_t k = 0; k < size; ++k) w->u[k][l] = u0 && k < NU ? u0[k] : candidates[(c + l) * size + k];
        vd size, cost = rollout_open(m, w, w->x, w->u, &size);
        for (int l = 0; l < LANES; ++l) J[c + l] = cost[l] < INFINITY ? cost[l] : INFINITY;
    }
}

int mpc_solve(const mpc_problem *m, const mpc_batch *b, int64_t first, int64_t stride) {
    lanes *w = lanes_new(m->horizon);
    if (!w) return 1;
    solve_range(m, b, w, first, stride);
    lanes_free(w);
    return 0;
}

/* Takes the start of each share of the candidates; shares of one need no costs. */
static void choose_starts(const mpc_problem *m, const mpc_batch *b, int64_t i, const double *candidates,
                          int64_t n_candidates, double *J, lanes *w, mpc_batch *starts) {
    int64_t N = m->horizon;
    const double *u0 = b->u0 ? b->u0 + i * NU : NULL;
    if (n_candidates > starts->n) candidate_costs(m, w, b->x0 + i * NX, starts->theta, u0, candidates, n_candidates, J);
    for (int64_t l = 0; l < starts->n; ++l) {
        int64_t cheapest = start_of(l, starts->n, J, n_candidates);
        memcpy(starts->u + l * N * NU, candidates + cheapest * N * NU, N * NU * sizeof(double));
        memcpy((double *)starts->x0 + l * NX, b->x0 + i * NX, NX * sizeof(double));
        if (u0) memcpy((double *)starts->u0 + l * NU, u0, NU * sizeof(double));
    }
}

static void swap(double *a, double *b, int64_t n) {
    for (int64_t k = 0; k < n; ++k) {
        double kept = a[k];
        a[k] = b[k];
        b[k] = kept;
    }
}

/* Moves the starts that a few iterations show to lead somewhere, and elsewhere, to the front. */
static void race(const mpc_problem *m, mpc_batch *starts, lanes *w, int64_t *chosen, int64_t *iterations) {
    int64_t N = m->horizon;
    mpc_problem short_one = *m;
    if (short_one.max_iterations > RACE_ITERATIONS) short_one.max_iterations = RACE_ITERATIONS;
    solve_range(&short_one, starts, w, 0, 1);
    for (int64_t l = 0; l < starts->n; ++l) {
        *iterations += starts->iterations[l];
        if (!(starts->J[l] < INFINITY)) starts->J[l] = INFINITY;
    }
    choose_finalists(starts->J, starts->n, chosen);
    for (int64_t l = 0; l < FINALISTS(starts->n); ++l) {
        int64_t from = chosen[l];
        for (int64_t c = l; c < FINALISTS(starts->n); ++c) /* a later finalist that is here goes to where this one was */
            if (chosen[c] == l) chosen[c] = from;
        swap(starts->J + l, starts->J + from, 1);
        swap(starts->size + l, starts->size + from, 1);
        swap(starts->u + l * N * NU, starts->u + from * N * NU, N * NU);
        swap(starts->x + l * (N + 1) * NX, starts->x + from * (N + 1) * NX, (N + 1) * NX);
    }
}

/* Cold solve of one problem; the best solution goes to row i of the batch. */
static void solve_cold(const mpc_problem *m, const mpc_batch *b, int64_t i, const double *candidates,
                       int64_t n_candidates, double *J, lanes *w, mpc_batch *starts, int64_t *chosen) {
    int64_t N = m->horizon, best = 0, iterations = 0;
    starts->theta = b->theta + i * b->theta_stride;
    choose_starts(m, b, i, candidates, n_candidates, J, w, starts);
    mpc_batch finals = *starts;
    if (starts->n > 1) {
        race(m, starts, w, chosen, &iterations);
        finals.n = FINALISTS(starts->n);
        finals.guess = ROLLOUT;
        finals.rivals = 1;
    }
    solve_range(m, &finals, w, 0, 1);
    for (int64_t l = 0; l < finals.n; ++l) {
        iterations += starts->iterations[l];
        int converged = starts->status[l] == CONVERGED, best_converged = starts->status[best] == CONVERGED;
        if (goes_before(starts->J[l], converged, starts->J[best], best_converged)) best = l;
    }
    memcpy(b->u + i * N * NU, starts->u + best * N * NU, N * NU * sizeof(double));
    memcpy(b->x + i * (N + 1) * NX, starts->x + best * (N + 1) * NX, (N + 1) * NX * sizeof(double));
    b->J[i] = starts->J[best];
    b->predicted[i] = starts->predicted[best];
    b->status[i] = starts->status[best];
    b->iterations[i] = iterations;
}

int mpc_solve_cold(const mpc_problem *m, const mpc_batch *b, const double *candidates, int64_t n_candidates,
                   int64_t n_starts, int64_t first, int64_t stride) {
    int64_t N = m->horizon, row = (N + 1) * NX + N * NU + NX + NU + 3;
    double *memory = calloc(n_starts * row + n_candidates, sizeof(double));
    int64_t *flags = calloc(3 * n_starts, sizeof(int64_t));
    lanes *w = lanes_new(N);
    int failed = !memory || !flags || !w;
    if (!failed) {
        double *q = memory + n_candidates;
        mpc_batch starts = {.n = n_starts, .guess = INPUTS, .iterations = flags, .status = flags + n_starts};
        starts.x = q, starts.x_guess = q; q += n_starts * (N + 1) * NX;
        starts.u = q, starts.u_guess = q; q += n_starts * N * NU;
        starts.x0 = q; q += n_starts * NX;
        starts.u0 = b->u0 ? q : NULL; q += n_starts * NU;
        starts.J = q; q += n_starts;
        starts.predicted = q; q += n_starts;
        starts.size = q;
        for (int64_t i = first; i < b->n; i += stride)
            solve_cold(m, b, i, candidates, n_candidates, memory, w, &starts, flags + 2 * n_starts);
    }
    lanes_free(w);
    free(memory);
    free(flags);
    return failed;
}
