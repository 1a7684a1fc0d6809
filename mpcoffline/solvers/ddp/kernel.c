/* Box-constrained differential dynamic programming (Gauss-Newton), LANES problems in lock step.
 *
 * Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014, with the discount inside the
 * recursion (V_k = L + gamma V_{k+1}), so that late stages stay well scaled, and with defects in the first backward pass
 * (Giftthaler et al., arXiv:1711.11006), so that a warm start need not obey the model.
 *
 * Included after generated code that defines NX, NU, NP, NQ and the functions
 *   gen_prepare(theta, out):   what depends on theta alone [NQ]; the others take p = (theta, that)
 *   gen_step(x, u, p, out):    x+ [NX], L [1]
 *   gen_q(x, u, x_next, Vx, Vxx, gamma, p, out):  f(x, u) - x_next [NX], Qx [NX], Qu [NU], Qxx [NX*NX], Qux [NU*NX],
 *                              Quu [NU*NU], fu'fx [NU*NX], fu'fu [NU*NU]
 *   gen_final(x, p, out):      T [1]
 *   gen_final_expand(x, p, out): Tx [NX], Txx [NX*NX]
 * with matrices column-major.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { CONVERGED = 0, ITERATION_LIMIT = 1, STALLED = 2, NOT_FINITE = 3, RUNNING = -1 };

#define MAX_BACKTRACKS 10
#define MU_FIRST 1e-6
#define MU_MIN 1e-9
#define MU_MAX 1e8
#define ARMIJO 1e-4

typedef struct {
    int64_t horizon;
    double discount;
    const double *low, *high; /* (NU) */
    int64_t max_iterations;
    double tolerance;         /* on the predicted decrease, relative to 1 + |J| */
} mpc_problem;

typedef struct {
    vd *x, *u, *x_new, *u_new; /* (N+1, NX), (N, NU) */
    vd *k, *K;                 /* feedforward (N, NU), feedback (N, NU, NX) column-major */
    vd p[NP + NQ + 1], s[NX], low0[NU], high0[NU];
    vd J, J_new, mu, predicted, defect;
    vl pd; /* lanes whose backward pass found a positive definite Quu */
} lanes;

static inline vl all_lanes(void) { return vd_le(V(0.0), V(0.0)); }

static lanes *lanes_new(int64_t N) {
    lanes *w = NULL;
    if (posix_memalign((void **)&w, 64, sizeof(lanes))) return NULL;
    memset(w, 0, sizeof(lanes));
    size_t sizes[6] = {(N + 1) * NX, N * NU, (N + 1) * NX, N * NU, N * NU, N * NU * NX};
    vd **fields[6] = {&w->x, &w->u, &w->x_new, &w->u_new, &w->k, &w->K};
    for (int i = 0; i < 6; ++i) {
        if (posix_memalign((void **)fields[i], 64, sizes[i] * sizeof(vd))) return NULL;
        memset(*fields[i], 0, sizes[i] * sizeof(vd));
    }
    return w;
}

static void lanes_free(lanes *w) {
    if (!w) return;
    free(w->x); free(w->u); free(w->x_new); free(w->u_new); free(w->k); free(w->K);
    free(w);
}

static inline vd clip(vd a, vd low, vd high) { return vd_min(vd_max(a, low), high); }

/* x+ and J along (x, u) -> open-loop states from s; returns the cost. */
static vd rollout_open(const mpc_problem *m, const lanes *w, vd *x, const vd *u) {
    vd J = V(0.0), out[NX + 1];
    double weight = 1.0;
    for (int i = 0; i < NX; ++i) x[i] = w->s[i];
    for (int64_t k = 0; k < m->horizon; ++k, weight *= m->discount) {
        gen_step(x + k * NX, u + k * NU, w->p, out);
        for (int i = 0; i < NX; ++i) x[(k + 1) * NX + i] = out[i];
        J += weight * out[NX];
    }
    gen_final(x + m->horizon * NX, w->p, out);
    return J + weight * out[0];
}

/* The closed-loop rollout of a step of length alpha (per lane) into x_new, u_new; sets J_new. */
static void rollout(const mpc_problem *m, lanes *w, vd alpha) {
    vd J = V(0.0), out[NX + 1], *x = w->x_new;
    double weight = 1.0;
    for (int i = 0; i < NX; ++i) x[i] = w->s[i];
    for (int64_t k = 0; k < m->horizon; ++k, weight *= m->discount) {
        const vd *K = w->K + k * NU * NX;
        vd dx[NX], *u = w->u_new + k * NU;
        for (int i = 0; i < NX; ++i) dx[i] = x[k * NX + i] - w->x[k * NX + i];
        for (int a = 0; a < NU; ++a) {
            vd v = w->u[k * NU + a] + alpha * w->k[k * NU + a];
            for (int i = 0; i < NX; ++i) v += K[i * NU + a] * dx[i];
            u[a] = clip(v, k ? V(m->low[a]) : w->low0[a], k ? V(m->high[a]) : w->high0[a]);
        }
        gen_step(x + k * NX, u, w->p, out);
        for (int i = 0; i < NX; ++i) x[(k + 1) * NX + i] = out[i];
        J += weight * out[NX];
    }
    gen_final(x + m->horizon * NX, w->p, out);
    w->J_new = J + weight * out[0];
}

/* Cholesky factor of the free part of H (clamped rows as identity), in place; clears lanes that are not positive definite. */
static void factorise(vd H[NU][NU], vl *pd) {
    for (int j = 0; j < NU; ++j) {
        vd d = H[j][j];
        for (int l = 0; l < j; ++l) d -= H[j][l] * H[j][l];
        vl ok = vd_lt(V(1e-14), d);
        *pd &= ok;
        d = vd_sqrt(vd_select(ok, d, V(1.0)));
        H[j][j] = d;
        for (int i = j + 1; i < NU; ++i) {
            vd v = H[i][j];
            for (int l = 0; l < j; ++l) v -= H[i][l] * H[j][l];
            H[i][j] = v / d;
        }
    }
}

static void substitute(vd H[NU][NU], vd b[NU]) {
    for (int i = 0; i < NU; ++i) {
        for (int l = 0; l < i; ++l) b[i] -= H[i][l] * b[l];
        b[i] /= H[i][i];
    }
    for (int i = NU - 1; i >= 0; --i) {
        for (int l = i + 1; l < NU; ++l) b[i] -= H[l][i] * b[l];
        b[i] /= H[i][i];
    }
}

/* min 1/2 d'Hd + g'd, low <= d <= high by an active set; returns which inputs are free and the factor of their H. */
static void box_qp(vd H[NU][NU], const vd g[NU], const vd low[NU], const vd high[NU], vd d[NU], vl is_free[NU],
                   vd F[NU][NU], vl *pd) {
    vl everywhere = all_lanes();
    for (int a = 0; a < NU; ++a) { is_free[a] = everywhere; d[a] = V(0.0); }
    for (int pass = 0; pass < 2 * NU + 1; ++pass) {
        vd b[NU];
        for (int i = 0; i < NU; ++i) {
            b[i] = -g[i];
            for (int j = 0; j < NU; ++j) {
                vl both = is_free[i] & is_free[j];
                F[i][j] = vd_select(both, H[i][j], V(i == j ? 1.0 : 0.0));
                b[i] -= vd_select(is_free[j], V(0.0), H[i][j] * d[j]);
            }
            b[i] = vd_select(is_free[i], b[i], d[i]);
        }
        factorise(F, pd);
        substitute(F, b);
        vl changed = everywhere ^ everywhere;
        for (int i = 0; i < NU; ++i) {
            vl outside = is_free[i] & (vd_lt(b[i], low[i]) | vd_lt(high[i], b[i]));
            d[i] = clip(b[i], low[i], high[i]);
            changed |= outside;
            is_free[i] &= ~outside;
        }
        if (!vl_any(changed)) {
            /* Free again the inputs whose gradient points inwards from their bound. */
            for (int i = 0; i < NU; ++i) {
                vd slope = g[i];
                for (int j = 0; j < NU; ++j) slope += H[i][j] * d[j];
                vl inwards = (vd_le(d[i], low[i]) & vd_lt(slope, V(0.0))) | (vd_le(high[i], d[i]) & vd_lt(V(0.0), slope));
                inwards &= ~is_free[i] & vd_lt(low[i], high[i]);
                changed |= inwards;
                is_free[i] |= inwards;
            }
        }
        if (!vl_any(changed) || NU == 1) break;
    }
    for (int i = 0; i < NU; ++i)
        for (int j = 0; j < NU; ++j) F[i][j] = vd_select(is_free[i] & is_free[j], H[i][j], V(i == j ? 1.0 : 0.0));
    factorise(F, pd);
}

/* Riccati recursion along (x, u): gains k, K, the predicted decrease of J, and where Quu was positive definite. */
static void backward(const mpc_problem *m, lanes *w) {
    vd Vx[NX], Vxx[NX * NX], out[NX + NX + NU + NX * NX + 2 * (NU * NX + NU * NU)];
    int64_t N = m->horizon;
    gen_final_expand(w->x + N * NX, w->p, out);
    for (int i = 0; i < NX; ++i) Vx[i] = out[i];
    for (int i = 0; i < NX * NX; ++i) Vxx[i] = out[NX + i];
    double weight = 1.0;
    for (int64_t k = 1; k < N; ++k) weight *= m->discount;
    vd discount = V(m->discount);
    w->pd = all_lanes();
    w->predicted = w->defect = V(0.0);
    for (int64_t k = N - 1; k >= 0; --k, weight /= m->discount) {
        const vd *u = w->u + k * NU;
        gen_q(w->x + k * NX, u, w->x + (k + 1) * NX, Vx, Vxx, &discount, w->p, out);
        const vd *Qx = out + NX, *Qu = Qx + NX, *Qxx = Qu + NU, *Qux = Qxx + NX * NX, *Quu = Qux + NU * NX;
        const vd *Rux = Quu + NU * NU, *Ruu = Rux + NU * NX;
        for (int i = 0; i < NX; ++i) w->defect = vd_max(w->defect, vd_abs(out[i]));
        /* Regularised as if Vxx were Vxx + mu / gamma I. */
        vd H[NU][NU];
        for (int a = 0; a < NU; ++a)
            for (int b = 0; b < NU; ++b)
                H[a][b] = Quu[b * NU + a] + w->mu * Ruu[b * NU + a] + (a == b ? w->mu * 1e-3 + 1e-12 : V(0.0));
        vd low[NU], high[NU], d[NU], F[NU][NU];
        vl is_free[NU];
        for (int a = 0; a < NU; ++a) {
            low[a] = (k ? V(m->low[a]) : w->low0[a]) - u[a];
            high[a] = (k ? V(m->high[a]) : w->high0[a]) - u[a];
        }
        box_qp(H, Qu, low, high, d, is_free, F, &w->pd);
        vd *K = w->K + k * NU * NX;
        for (int i = 0; i < NX; ++i) {
            vd b[NU];
            for (int a = 0; a < NU; ++a) b[a] = vd_select(is_free[a], -Qux[i * NU + a] - w->mu * Rux[i * NU + a], V(0.0));
            substitute(F, b);
            for (int a = 0; a < NU; ++a) K[i * NU + a] = b[a];
        }
        /* Value of the step: V <- Q(dx, d + K dx). */
        vd QuuK[NU][NX], half = V(0.0), slope = V(0.0), Quud[NU];
        for (int a = 0; a < NU; ++a) {
            w->k[k * NU + a] = d[a];
            Quud[a] = V(0.0);
            for (int b = 0; b < NU; ++b) Quud[a] += Quu[b * NU + a] * d[b];
            slope += Qu[a] * d[a];
            half += 0.5 * d[a] * Quud[a];
            for (int i = 0; i < NX; ++i) {
                QuuK[a][i] = V(0.0);
                for (int b = 0; b < NU; ++b) QuuK[a][i] += Quu[b * NU + a] * K[i * NU + b];
            }
        }
        w->predicted -= weight * (slope + half);
        for (int i = 0; i < NX; ++i) {
            Vx[i] = Qx[i];
            for (int a = 0; a < NU; ++a) Vx[i] += K[i * NU + a] * (Quud[a] + Qu[a]) + Qux[i * NU + a] * d[a];
        }
        for (int i = 0; i < NX; ++i)
            for (int j = i; j < NX; ++j) {
                vd v = Qxx[j * NX + i];
                for (int a = 0; a < NU; ++a)
                    v += K[i * NU + a] * (QuuK[a][j] + Qux[j * NU + a]) + Qux[i * NU + a] * K[j * NU + a];
                Vxx[j * NX + i] = Vxx[i * NX + j] = v;
            }
    }
}

/* One problem per lane; lane i works on problem queue[i] or on nothing (-1). */
typedef struct {
    int64_t n;
    const double *x0, *theta, *u0; /* (n, NX), (n, NP), (n, NU) or NULL */
    double *x, *u, *J, *predicted;  /* (n, N+1, NX), (n, N, NU): guess in, solution out; (n), (n) */
    int64_t *iterations, *status;  /* (n) */
    int cold;                       /* the guess is inputs only */
} mpc_batch;

static void load_lane(const mpc_problem *m, const mpc_batch *b, lanes *w, int lane, int64_t i) {
    int64_t N = m->horizon;
    for (int j = 0; j < NP; ++j) w->p[j][lane] = b->theta[i * NP + j];
    for (int j = 0; j < NX; ++j) w->s[j][lane] = b->x0[i * NX + j];
    for (int a = 0; a < NU; ++a) {
        w->low0[a][lane] = b->u0 ? b->u0[i * NU + a] : m->low[a];
        w->high0[a][lane] = b->u0 ? b->u0[i * NU + a] : m->high[a];
    }
    for (int64_t k = 0; k < N * NU; ++k) {
        double v = b->u[i * N * NU + k], low = m->low[k % NU], high = m->high[k % NU];
        if (b->u0 && k < NU) low = high = b->u0[i * NU + k];
        w->u[k][lane] = v < low ? low : v > high ? high : v;
    }
    for (int64_t k = 0; k < (N + 1) * NX; ++k) w->x[k][lane] = b->x[i * (N + 1) * NX + k];
    for (int j = 0; j < NX; ++j) w->x[j][lane] = w->s[j][lane];
    w->J[lane] = INFINITY;
    w->mu[lane] = 0.0;
}

static void store_lane(const mpc_problem *m, const mpc_batch *b, const lanes *w, int lane, int64_t i, int64_t status,
                       int64_t iterations) {
    int64_t N = m->horizon;
    for (int64_t k = 0; k < N * NU; ++k) b->u[i * N * NU + k] = w->u[k][lane];
    for (int64_t k = 0; k < (N + 1) * NX; ++k) b->x[i * (N + 1) * NX + k] = w->x[k][lane];
    b->J[i] = w->J[lane];
    b->predicted[i] = w->predicted[lane];
    b->status[i] = status;
    b->iterations[i] = iterations;
}

/* Copies the new trajectory where the mask says so. */
static void accept(const mpc_problem *m, lanes *w, vl mask) {
    for (int64_t k = 0; k < m->horizon * NU; ++k) w->u[k] = vd_select(mask, w->u_new[k], w->u[k]);
    for (int64_t k = 0; k < (m->horizon + 1) * NX; ++k) w->x[k] = vd_select(mask, w->x_new[k], w->x[k]);
    w->J = vd_select(mask, w->J_new, w->J);
}

/* Solves problems first, first + stride, ... of the batch; a lane that finishes takes the next one. */
static int solve_range(const mpc_problem *m, const mpc_batch *b, int64_t first, int64_t stride) {
    lanes *w = lanes_new(m->horizon);
    if (!w) return 1;
    int64_t problem[LANES], count[LANES], next = first;
    int fresh_any, busy;
    for (int l = 0; l < LANES; ++l) problem[l] = -1;
    for (;;) {
        vl fresh = all_lanes() ^ all_lanes();
        fresh_any = busy = 0;
        int64_t spare = -1;
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0 && next < b->n) {
                load_lane(m, b, w, l, problem[l] = next);
                next += stride;
                count[l] = 0;
                fresh[l] = -1;
                fresh_any = 1;
            }
            if (problem[l] >= 0) { busy = 1; spare = problem[l]; }
        }
        if (!busy) break;
        for (int l = 0; l < LANES; ++l)
            if (problem[l] < 0) load_lane(m, b, w, l, spare); /* idle lanes repeat a problem: finite numbers, ignored */
        if (fresh_any) gen_prepare(w->p, w->p + NP);
        if (fresh_any && b->cold) {
            vd J = rollout_open(m, w, w->x_new, w->u);
            for (int64_t k = 0; k < (m->horizon + 1) * NX; ++k) w->x[k] = vd_select(fresh, w->x_new[k], w->x[k]);
            w->J = vd_select(fresh, J, w->J);
        }
        backward(m, w);
        /* A point is a solution when the model holds and the quadratic model promises no further decrease. */
        vd scale = V(1.0) + vd_abs(w->J);
        vl finite_J = vd_lt(vd_abs(w->J), V(INFINITY));
        /* A warm start that obeys the model is as good as a rollout, only its cost is not known before the step. */
        vl nearly = vd_lt(w->defect, V(1e-9));
        vl small = finite_J & w->pd & vd_lt(w->predicted, m->tolerance * scale);
        /* A step found with heavy regularisation promises little without being near a solution. */
        small &= vd_le(w->mu, V(1.0));
        vl open = all_lanes(), moved = open ^ open;
        vd alpha = V(1.0);
        for (int trial = 0; trial < MAX_BACKTRACKS; ++trial) {
            rollout(m, w, alpha);
            vl better = vd_lt(w->J_new, w->J - ARMIJO * alpha * vd_max(w->predicted, V(0.0)));
            better &= vd_lt(vd_abs(w->J_new), V(INFINITY)) & open & w->pd;
            accept(m, w, better);
            moved |= better;
            open &= ~better & w->pd & ~small; /* the last step of a solution is tried once, at full length */
            int wanted = 0;
            for (int l = 0; l < LANES; ++l) wanted |= problem[l] >= 0 && open[l];
            if (!wanted) break;
            alpha = alpha * 0.4;
        }
        for (int l = 0; l < LANES; ++l) {
            if (problem[l] < 0) continue;
            int64_t status = RUNNING;
            ++count[l];
            if (small[l] || (nearly[l] && moved[l] && w->pd[l] && w->mu[l] <= 1.0 &&
                             w->predicted[l] < m->tolerance * (1.0 + fabs(w->J[l]))))
                status = CONVERGED;
            else if (moved[l]) w->mu[l] = w->mu[l] * 0.2 > MU_MIN ? w->mu[l] * 0.2 : 0.0;
            else {
                w->mu[l] = w->mu[l] > 0.0 ? w->mu[l] * 8.0 : MU_FIRST;
                if (!(w->mu[l] < MU_MAX)) status = STALLED;
            }
            if (status == RUNNING && count[l] >= m->max_iterations) status = ITERATION_LIMIT;
            if (status != RUNNING) {
                if (!(w->J[l] < INFINITY && w->J[l] > -INFINITY)) status = NOT_FINITE;
                store_lane(m, b, w, l, problem[l], status, count[l]);
                problem[l] = -1;
            }
        }
    }
    lanes_free(w);
    return 0;
}

/* Open-loop costs of n_candidates input sequences (a multiple of LANES) from one state; J (n_candidates). */
static void candidate_costs(const mpc_problem *m, lanes *w, const double *x0, const double *theta, const double *u0,
                            const double *candidates, int64_t n_candidates, double *J) {
    int64_t size = m->horizon * NU;
    for (int j = 0; j < NP; ++j) w->p[j] = V(theta[j]);
    gen_prepare(w->p, w->p + NP);
    for (int j = 0; j < NX; ++j) w->s[j] = V(x0[j]);
    for (int64_t c = 0; c < n_candidates; c += LANES) {
        for (int l = 0; l < LANES; ++l)
            for (int64_t k = 0; k < size; ++k) w->u[k][l] = u0 && k < NU ? u0[k] : candidates[(c + l) * size + k];
        vd cost = rollout_open(m, w, w->x, w->u);
        for (int l = 0; l < LANES; ++l) J[c + l] = cost[l] < INFINITY ? cost[l] : INFINITY;
    }
}

int mpc_solve(const mpc_problem *m, const mpc_batch *b, int64_t first, int64_t stride) {
    return solve_range(m, b, first, stride);
}

/* Cold solve of one problem from the LANES cheapest candidates; the best solution goes to row i of the batch. */
static int solve_cold(const mpc_problem *m, const mpc_batch *b, int64_t i, const double *candidates,
                      int64_t n_candidates, double *J, lanes *w, const mpc_batch *starts) {
    int64_t N = m->horizon, best = 0;
    const double *u0 = b->u0 ? b->u0 + i * NU : NULL;
    candidate_costs(m, w, b->x0 + i * NX, b->theta + i * NP, u0, candidates, n_candidates, J);
    for (int64_t l = 0; l < starts->n; ++l) {
        int64_t cheapest = 0;
        for (int64_t c = 1; c < n_candidates; ++c)
            if (J[c] < J[cheapest]) cheapest = c;
        J[cheapest] = INFINITY;
        memcpy(starts->u + l * N * NU, candidates + cheapest * N * NU, N * NU * sizeof(double));
        memcpy((double *)starts->x0 + l * NX, b->x0 + i * NX, NX * sizeof(double));
        memcpy((double *)starts->theta + l * NP, b->theta + i * NP, NP * sizeof(double));
        if (u0) memcpy((double *)starts->u0 + l * NU, u0, NU * sizeof(double));
    }
    if (solve_range(m, starts, 0, 1)) return 1;
    int64_t iterations = 0;
    for (int64_t l = 0; l < starts->n; ++l) {
        iterations += starts->iterations[l];
        /* A converged solution that is as good as the best goes before one that is not. */
        double slack = 1e-6 * (1.0 + (starts->J[best] < 0 ? -starts->J[best] : starts->J[best]));
        int nearly = starts->J[l] < starts->J[best] + slack;
        int closer = starts->status[l] == CONVERGED && starts->status[best] != CONVERGED && nearly;
        int same = (starts->status[l] == CONVERGED) == (starts->status[best] == CONVERGED);
        if (closer || (starts->J[l] < starts->J[best] - (same ? 0.0 : slack)) || !(starts->J[best] < INFINITY)) best = l;
    }
    memcpy(b->u + i * N * NU, starts->u + best * N * NU, N * NU * sizeof(double));
    memcpy(b->x + i * (N + 1) * NX, starts->x + best * (N + 1) * NX, (N + 1) * NX * sizeof(double));
    b->J[i] = starts->J[best];
    b->predicted[i] = starts->predicted[best];
    b->status[i] = starts->status[best];
    b->iterations[i] = iterations;
    return 0;
}

int mpc_solve_cold(const mpc_problem *m, const mpc_batch *b, const double *candidates, int64_t n_candidates,
                   int64_t n_starts, int64_t first, int64_t stride) {
    int64_t N = m->horizon, row = (N + 1) * NX + N * NU + NX + NP + NU + 2;
    double *memory = calloc(n_starts * row + n_candidates, sizeof(double));
    int64_t *flags = calloc(2 * n_starts, sizeof(int64_t));
    lanes *w = lanes_new(N);
    int failed = !memory || !flags || !w;
    if (!failed) {
        double *q = memory + n_candidates;
        mpc_batch starts = {.n = n_starts, .cold = 1, .iterations = flags, .status = flags + n_starts};
        starts.x = q; q += n_starts * (N + 1) * NX;
        starts.u = q; q += n_starts * N * NU;
        starts.x0 = q; q += n_starts * NX;
        starts.theta = q; q += n_starts * NP;
        starts.u0 = b->u0 ? q : NULL; q += n_starts * NU;
        starts.J = q; q += n_starts;
        starts.predicted = q;
        for (int64_t i = first; i < b->n && !failed; i += stride)
            failed = solve_cold(m, b, i, candidates, n_candidates, memory, w, &starts);
    }
    lanes_free(w);
    free(memory);
    free(flags);
    return failed;
}
