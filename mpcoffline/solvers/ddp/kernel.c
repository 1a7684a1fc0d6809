/* Batches of problems: LANES of them in lock step through the iterations of core.c. */
#include <stdlib.h>
#include <string.h>

static void lanes_free(lanes *w) {
    if (!w) return;
    free(w->x); free(w->u); free(w->x_new); free(w->u_new); free(w->k); free(w->K);
#if LIMITS
    free(w->c.h); free(w->c.h_new); free(w->c.multiplier);
#endif
    free(w);
}

static lanes *lanes_new(int64_t N) {
    lanes *w = NULL;
    if (posix_memalign((void **)&w, 64, sizeof(lanes))) return NULL;
    memset(w, 0, sizeof(lanes));
#if LIMITS
    enum { FIELDS = 9 };
    size_t along = (N + 1) * LIMITS, sizes[] = {(N + 1) * NX, N * NU, (N + 1) * NX, N * NU, N * NU, N * NU * NX,
                                                along, along, along};
    vd **fields[] = {&w->x, &w->u, &w->x_new, &w->u_new, &w->k, &w->K, &w->c.h, &w->c.h_new, &w->c.multiplier};
#else
    enum { FIELDS = 6 };
    size_t sizes[] = {(N + 1) * NX, N * NU, (N + 1) * NX, N * NU, N * NU, N * NU * NX};
    vd **fields[] = {&w->x, &w->u, &w->x_new, &w->u_new, &w->k, &w->K};
#endif
    for (int i = 0; i < FIELDS; ++i) {
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
    int stays;                       /* the last one is a PLAN, whatever the others are */
#if LIMITS
    const double *limits_guess;     /* (n, N+4, LIMITS), or one for all: see MULTIPLIER_ROWS */
    int64_t limits_stride;          /* (N+4) LIMITS, or 0 */
    double *limits;                 /* (n, N+4, LIMITS) */
    double *violation, *now;        /* (n): as appraise says */
    int64_t *worst;                 /* (n) */
    double *amount;                 /* (n): of the worst, in its own unit */
#endif
} mpc_batch;

/* Whether x_guess of a problem need not obey the model, and nothing is known of what it costs. */
static int is_plan(const mpc_batch *b, int64_t i) { return b->guess == PLAN || (b->stays && i == b->n - 1); }

/* One theta for all lanes. */
static void load_theta(lanes *w, const double *theta) {
    for (int j = 0; j < NP; ++j) w->p[j] = V(theta[j]);
    gen_prepare(w->p, w->p + NP);
}

#if LIMITS
static void load_limits(const mpc_problem *m, const mpc_batch *b, lanes *w, int lane, int64_t i) {
    limits *c = &w->c;
    const double *from = b->limits_guess + i * b->limits_stride, *rho = from + (m->horizon + 1) * LIMITS;
    for (int64_t k = 0; k < (m->horizon + 1) * LIMITS; ++k) c->multiplier[k][lane] = from[k];
    for (int j = 0; j < LIMITS; ++j) {
        double first = rho[LIMITS + j];
        c->rho[j][lane] = relaxed(rho[j], first);
        c->first_rho[j][lane] = first;
        c->scale[j][lane] = rho[2 * LIMITS + j];
        c->before[j][lane] = INFINITY, c->stuck[j][lane] = 0.0;
    }
    double tolerance = b->guess == PLAN ? WARM_TOLERANCE : FIRST_TOLERANCE;
    c->tolerance[lane] = tolerance > m->tolerance ? tolerance : m->tolerance;
    c->looser[lane] = sqrt(c->tolerance[lane] / m->tolerance);
    c->inner[lane] = c->dominated[lane] = 0.0;
    c->given = b->u0 != NULL;
    weigh(c);
}

static void store_limits(const mpc_problem *m, const mpc_batch *b, const lanes *w, int lane, int64_t i) {
    const limits *c = &w->c;
    int64_t N = m->horizon;
    double *to = b->limits + i * MULTIPLIER_ROWS(N) * LIMITS, *rho = to + (N + 1) * LIMITS;
    for (int64_t k = 0; k < (N + 1) * LIMITS; ++k) to[k] = c->multiplier[k][lane];
    for (int j = 0; j < END_FIRST; ++j) to[N * LIMITS + j] = c->multiplier[(N - 1) * LIMITS + j][lane]; /* to be held */
    for (int j = 0; j < LIMITS; ++j) {
        rho[j] = c->rho[j][lane];
        rho[LIMITS + j] = c->first_rho[j][lane];
        rho[2 * LIMITS + j] = c->scale[j][lane];
    }
}
#endif

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
    int plan = is_plan(b, i), known = b->guess == ROLLOUT && !plan;
    if (plan || known)
        for (int64_t k = 0; k < (N + 1) * NX; ++k) w->x[k][lane] = b->x_guess[i * (N + 1) * NX + k];
    for (int j = 0; j < NX; ++j) w->x[j][lane] = w->s[j][lane];
    w->J[lane] = known ? b->J[i] : INFINITY;
    w->size[lane] = known ? b->size[i] : INFINITY;
    w->mu[lane] = w->alpha[lane] = 0.0;
#if LIMITS
    load_limits(m, b, w, lane, i);
#endif
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

#if LIMITS
#define HOPELESS 3.0         /* times in a row, when the iterations are used up: then it cannot be kept */

/* Lanes with a hard limit that comes no closer to being kept, however much is paid. */
static vl is_hopeless(const lanes *w) {
    vl lost = no_lanes();
    for (int j = 0; j < LIMITS; ++j)
        if (!(limit_l1[j] < INFINITY)) lost |= vd_le(V(HOPELESS), w->c.stuck[j]);
    return lost & vd_lt(V(0.0), w->c.dominated);
}

/* The same, with the true cost and the worst violation, and multipliers for the next plan; a solution that is only one of a
 * race is stored as it is compared. Returns the status: whatever the algorithm says, a solution keeps its limits. */
static int64_t store_limited(const mpc_problem *m, const mpc_batch *b, lanes *w, int lane, int64_t i, int64_t status,
                             int64_t iterations) {
    store_lane(m, b, w, lane, i, status, iterations);
    if (m->race) return b->status[i];
    vd cost, violation, worst, now, off[LIMITS];
    appraise(m, w, &cost, &violation, &worst, &now);
    b->J[i] = cost[lane], b->violation[i] = violation[lane], b->now[i] = now[lane], b->worst[i] = (int64_t)worst[lane];
    double amount = w->c.h[b->worst[i]][lane];
    b->amount[i] = violation[lane] > 0.0 ? amount : 0.0;
    store_limits(m, b, w, lane, i);
    if (status == ITERATION_LIMIT && b->status[i] == status) { /* near enough */
        vd overpaid = distances(m, w, off);
        vl near = acceptable(m, w) & is_near(w, off, overpaid);
        if (near[lane]) b->status[i] = CONVERGED;
        else if (violation[lane] > FEASIBLE && is_hopeless(w)[lane]) b->status[i] = INFEASIBLE;
    }
    if (b->status[i] == CONVERGED && !(violation[lane] <= FEASIBLE)) b->status[i] = INFEASIBLE; /* by an imposed input */
    return b->status[i];
}
#endif

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
        vl fresh = no_lanes(); /* lanes whose inputs have to be rolled out first */
        fresh_any = busy = 0;
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0 && next < b->n) {
                load_lane(m, b, w, l, problem[l] = next);
                next += stride;
                count[l] = 0;
                fresh[l] = -!is_plan(b, problem[l]);
                fresh_any = 1;
            }
            busy |= problem[l] >= 0;
        }
        if (!busy) break;
        if (fresh_any && b->theta_stride) gen_prepare(w->p, w->p + NP);
        if (fresh_any && b->guess == INPUTS) {
            vd size, J = rollout_open(m, w, w->x_new, w->u, fresh, &size);
            for (int64_t k = 0; k < (m->horizon + 1) * NX; ++k) w->x[k] = vd_select(fresh, w->x_new[k], w->x[k]);
            w->J = vd_select(fresh, J, w->J);
            w->size = vd_select(fresh, size, w->size);
#if LIMITS
            w->c.base = vd_select(fresh, w->c.base_new, w->c.base);
            w->c.base_size = vd_select(fresh, w->c.base_size_new, w->c.base_size);
            for (int64_t k = 0; k < (m->horizon + 1) * LIMITS; ++k)
                w->c.h[k] = vd_select(fresh, w->c.h_new[k], w->c.h[k]);
#endif
        }
        vl wanted = no_lanes(), converged, moved, stalled;
        for (int l = 0; l < LANES; ++l) wanted[l] = -(problem[l] >= 0);
        iterate(m, w, wanted, &converged, &moved, &stalled);
#if LIMITS
        vl lost = m->race ? no_lanes() : tighten(m, w, &converged, &stalled);
#endif
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0) continue;
            int64_t status = converged[l] ? CONVERGED : stalled[l] ? STALLED : RUNNING;
            ++count[l];
#if LIMITS
            if (lost[l]) status = INFEASIBLE;
            if (status == RUNNING && count[l] >= m->max_iterations) status = ITERATION_LIMIT;
            if (b->rivals && status == RUNNING && is_beaten(w, l, best)) status = ITERATION_LIMIT;
            if (status != RUNNING) {
                status = store_limited(m, b, w, l, problem[l], status, count[l]);
                if (b->rivals && status == CONVERGED && b->J[problem[l]] < best) best = b->J[problem[l]];
                problem[l] = -1;
            }
#else
            if (status == RUNNING && count[l] >= m->max_iterations)
                status = acceptable(m, w)[l] ? CONVERGED : ITERATION_LIMIT;
            if (b->rivals && status == CONVERGED && w->J[l] < best) best = w->J[l];
            if (b->rivals && status == RUNNING && is_beaten(w, l, best)) status = ITERATION_LIMIT;
            if (status != RUNNING) {
                store_lane(m, b, w, l, problem[l], status, count[l]);
                problem[l] = -1;
            }
#endif
        }
    }
}

/* Open-loop costs of n_candidates input sequences (a multiple of LANES) from one state; J (n_candidates). */
static void candidate_costs(const mpc_problem *m, lanes *w, const double *x0, const double *theta, const double *u0,
                            const double *candidates, int64_t n_candidates, double *J) {
    int64_t size = m->horizon * NU;
    load_theta(w, theta);
    for (int j = 0; j < NX; ++j) w->s[j] = V(x0[j]);
    for (int a = 0; a < NU; ++a) w->low0[a] = V(u0 ? u0[a] : m->low[a]), w->high0[a] = V(u0 ? u0[a] : m->high[a]);
    for (int64_t c = 0; c < n_candidates; c += LANES) {
        for (int l = 0; l < LANES; ++l)
            for (int64_t k = 0; k < size; ++k) w->u[k][l] = u0 && k < NU ? u0[k] : candidates[(c + l) * size + k];
        vd size, cost = rollout_open(m, w, w->x, w->u, all_lanes(), &size);
        for (int l = 0; l < LANES; ++l) J[c + l] = cost[l] < INFINITY ? cost[l] : INFINITY;
#if LIMITS
        if (w->c.asked) note(m, w, w->c.asked);
#endif
    }
}

#if LIMITS
/* Multipliers of zero, and weights and scales by the candidates, for a problem and for all lanes. */
static void first_limits(const mpc_problem *m, const mpc_batch *b, int64_t i, const double *candidates,
                         int64_t n_candidates, lanes *w, double *rows) {
    double *memory = malloc(SURVEY_SIZE * sizeof(double));
    double *rho = rows + (m->horizon + 1) * LIMITS, costs[MOST_CANDIDATES];
    w->c.given = b->u0 != NULL;
    for (int64_t k = 0; k < (m->horizon + 1) * LIMITS; ++k) rows[k] = 0.0, w->c.multiplier[k] = V(0.0);
    for (int j = 0; j < LIMITS; ++j) rho[j] = rho[LIMITS + j] = rho[2 * LIMITS + j] = 1.0;
    if (memory) {
        survey s = survey_in(memory);
        w->c.asked = &s;
        candidate_costs(m, w, b->x0 + i * NX, b->theta + i * b->theta_stride, b->u0 ? b->u0 + i * NU : NULL, candidates,
                        n_candidates, costs);
        w->c.asked = NULL;
        conclude(m, &s, rho + LIMITS, rho + 2 * LIMITS);
        free(memory);
    }
    for (int j = 0; j < LIMITS; ++j) {
        rho[j] = rho[LIMITS + j];
        w->c.rho[j] = w->c.first_rho[j] = V(rho[j]);
        w->c.scale[j] = V(rho[2 * LIMITS + j]);
    }
    weigh(&w->c);
}

/* What first_limits says of problems, to limits; of plans whose inputs are in u_guess, violation and worst. */
int mpc_limits(const mpc_problem *m, const mpc_batch *b, const double *candidates, int64_t n_candidates) {
    lanes *w = lanes_new(m->horizon);
    if (!w) return 1;
    for (int64_t i = 0; i < b->n; ++i) {
        first_limits(m, b, i, candidates, n_candidates, w, b->limits + i * MULTIPLIER_ROWS(m->horizon) * LIMITS);
        if (!b->u_guess) continue;
        vd size, cost, violation, worst, now;
        for (int64_t k = 0; k < m->horizon * NU; ++k) w->u[k] = V(b->u_guess[i * m->horizon * NU + k]);
        w->J = rollout_open(m, w, w->x, w->u, no_lanes(), &size);
        for (int64_t k = 0; k < (m->horizon + 1) * LIMITS; ++k) w->c.h[k] = w->c.h_new[k];
        w->c.base = w->c.base_new;
        appraise(m, w, &cost, &violation, &worst, &now);
        b->violation[i] = violation[0] > FEASIBLE ? violation[0] : 0.0;
        b->worst[i] = (int64_t)worst[0];
    }
    lanes_free(w);
    return 0;
}
#endif

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
#if LIMITS
    short_one.race = 1;
#endif
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

/* Makes the last of the finalists a plan that stays at x0. Where the plant is unstable, all input sequences lead far away,
 * and there they end in minima of their own; along this plan the first backward pass finds a feedback that holds it. */
static void stay(const mpc_problem *m, const mpc_batch *b, int64_t i, mpc_batch *finals) {
    int64_t N = m->horizon, last = finals->n++;
    double *x = finals->x + last * (N + 1) * NX, *u = finals->u + last * N * NU;
    for (int64_t k = 0; k < (N + 1) * NX; ++k) x[k] = b->x0[i * NX + k % NX];
    for (int64_t k = 0; k < N * NU; ++k) u[k] = m->rest[k % NU];
    finals->stays = 1;
}

/* Cold solve of one problem; the best solution goes to row i of the batch. */
static void solve_cold(const mpc_problem *m, const mpc_batch *b, int64_t i, const double *candidates,
                       int64_t n_candidates, double *J, lanes *w, mpc_batch *starts, int64_t *chosen) {
    int64_t N = m->horizon, best = 0, iterations = 0;
    starts->theta = b->theta + i * b->theta_stride;
#if LIMITS
    first_limits(m, b, i, candidates, n_candidates, w, (double *)starts->limits_guess);
#endif
    choose_starts(m, b, i, candidates, n_candidates, J, w, starts);
    mpc_batch finals = *starts;
    if (starts->n > 1) {
        race(m, starts, w, chosen, &iterations);
        finals.n = FINALISTS(starts->n);
        finals.guess = LIMITS ? INPUTS : ROLLOUT; /* with limits a rollout is more than its states and costs */
        finals.rivals = 1;
        stay(m, b, i, &finals); /* FINALISTS(n) < n: there is a row for it */
    }
    solve_range(m, &finals, w, 0, 1);
    for (int64_t l = 0; l < finals.n; ++l) {
        iterations += starts->iterations[l];
        int converged = starts->status[l] == CONVERGED, best_converged = starts->status[best] == CONVERGED;
#if LIMITS
        int first = keeps_better(starts->violation[l], starts->violation[best]);
        if (first > 0) best = l;
        if (first) continue;
#endif
        if (goes_before(starts->J[l], converged, starts->J[best], best_converged)) best = l;
    }
    memcpy(b->u + i * N * NU, starts->u + best * N * NU, N * NU * sizeof(double));
    memcpy(b->x + i * (N + 1) * NX, starts->x + best * (N + 1) * NX, (N + 1) * NX * sizeof(double));
    b->J[i] = starts->J[best];
    b->predicted[i] = starts->predicted[best];
    b->status[i] = starts->status[best];
    b->iterations[i] = iterations;
#if LIMITS
    int64_t rows = MULTIPLIER_ROWS(N) * LIMITS;
    memcpy(b->limits + i * rows, starts->limits + best * rows, rows * sizeof(double));
    b->violation[i] = starts->violation[best], b->now[i] = starts->now[best], b->worst[i] = starts->worst[best];
    b->amount[i] = starts->amount[best];
#endif
}

int mpc_solve_cold(const mpc_problem *m, const mpc_batch *b, const double *candidates, int64_t n_candidates,
                   int64_t n_starts, int64_t first, int64_t stride) {
    int64_t N = m->horizon, row = (N + 1) * NX + N * NU + NX + NU + 3;
#if LIMITS
    int64_t rows = MULTIPLIER_ROWS(N) * LIMITS;
    row += 2 * rows + 3;
#endif
    double *memory = calloc(n_starts * row + n_candidates, sizeof(double));
    int64_t *flags = calloc((LIMITS ? 4 : 3) * n_starts, sizeof(int64_t));
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
        starts.size = q; q += n_starts;
#if LIMITS
        starts.limits = q; q += n_starts * rows;
        starts.limits_guess = q; q += n_starts * rows;
        starts.violation = q; q += n_starts;
        starts.now = q; q += n_starts;
        starts.amount = q;
        starts.worst = flags + 3 * n_starts;
#endif
        for (int64_t i = first; i < b->n; i += stride)
            solve_cold(m, b, i, candidates, n_candidates, memory, w, &starts, flags + 2 * n_starts);
    }
    lanes_free(w);
    free(memory);
    free(flags);
    return failed;
}
