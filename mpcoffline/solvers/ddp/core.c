/* Box-constrained differential dynamic programming (Gauss-Newton), LANES problems in lock step.
 *
 * Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014, with the discount inside the
 * recursion (V_k = L + gamma V_{k+1}), so that late stages stay well scaled, and with defects in the first backward pass
 * (Giftthaler et al., arXiv:1711.11006), so that a warm start need not obey the model.
 *
 * Included after generated code that defines NX, NU, NP, NQ and the functions
 *   gen_prepare(theta, out):   what depends on theta alone [NQ]; the others take p = (theta, that)
 *   gen_step(x, u, p, out):    x+ [NX], L [1]
 *   gen_q(x, u, x_next, Vx, Vxx, gamma, p, out):  f(x, u) - x_next [NX], Qx [NX], Qu [NU], Qxx [NT], Qux [NU*NX],
 *                              Quu [NU*NU]; unless STAGE_CONVEX, what gen_stage_expand gave comes before p
 *   gen_stage_expand(x, u, p, out): unless STAGE_CONVEX: gradient of L by (x, u) [NZ], Hessian [NZ (NZ + 1) / 2]
 *   gen_final(x, p, out):      T [1]
 *   gen_final_expand(x, p, out): Tx [NX], Txx [NT]
 * with matrices column-major, and Vxx, Qxx, Txx and the Hessian of L as upper triangles column by column
 * (NT = NX (NX + 1) / 2, NZ = NX + NU); and STAGE_CONVEX, TERMINAL_CONVEX: whether L, T are convex for any theta, or L is
 * to be taken as it is, with the curvature of f: then Quu need not be positive definite, and steps are regularised until
 * it is. Of those that are neither, the positive semidefinite part of the Hessian is used.
 *
 * Nothing here knows how many lanes there are: vd is one double or a vector of them, vl the result of comparing them.
 *
 * No lane looks at another: a problem's result is the same to the bit whatever is solved next to it.
 *
 * No unit matters: costs are compared with the size of their own terms, inputs with those of the plan or their range.
 *
 * Where there are limits besides the bounds of inputs (LIMITS > 0), constraints.h comes before and constraints.c after. Where
 * there are some to what inputs may change by (RATES > 0), input a stays within rate_down[a] and rate_up[a] of the one
 * before, x[rate_place[a]] (-1: it has none): no trajectory leaves that, and an input at such a bound moves along with it.
 */
#include <stdint.h>

enum { CONVERGED = 0, ITERATION_LIMIT = 1, STALLED = 2, NOT_FINITE = 3, INFEASIBLE = 4, RUNNING = -1 };

#define MAX_BACKTRACKS 10
#define MU_FIRST 1e-3 /* regularisation relative to Quu */
#define MU_MIN 1e-5
#define MU_MAX 1e6
#define ARMIJO 1e-4
#define SHORTEST_STEP 0.5 /* of those tried first, when two steps in a row suggest a length other than 1 */
#define LONGEST_STEP 5.0
#define INPUT_TOLERANCE 3e-5 /* of the first input, relative to the largest of the plan, */
#define LEAST_INPUT 1e-6     /* which counts as at least this part of the range */
#define DEFECT_TOLERANCE 1e2 /* times the tolerance is what defects of the model may cost */
#define ROUNDING 1e-15       /* of the states in a step, relative */
#define ACCEPTABLE 1e3 /* times the tolerance is good enough once the iterations are used up */
#define RIDGE 1e-12   /* keeps a singular Quu invertible, relative to its rows */
#define TINY 1e-290   /* keeps one that is zero so, where nothing depends on an input */
#define RACE_ITERATIONS 3 /* of each start of a cold solve, before the best go on */
#define FINALISTS(starts) (((starts) + 3) / 4)
#define DISTINCT 1e-2     /* starts whose costs differ by less, relative to |J|, most often lead to the same minimum */
#define BEATEN 1e-4 /* relative to |J|: a solution better by less is not worth further iterations */
#define NT (NX * (NX + 1) / 2)
#define NZ (NX + NU)
#define TRI(i, j) ((j) * ((j) + 1) / 2 + (i)) /* of an upper triangle, i <= j */

typedef struct {
    int64_t horizon;
    double discount;
    const double *low, *high; /* (NU) */
    const double *unit;       /* (NU): sizes of the inputs against each other */
    const double *rest;       /* (NU): the inputs of a plan that stays where it is */
    int64_t max_iterations;
    double tolerance;         /* on the predicted decrease, relative to the sum of the magnitudes of the costs */
#if LIMITS
    int race; /* whether multipliers stay as they are */
#endif
} mpc_problem;

typedef struct {
    vd *x, *u, *x_new, *u_new; /* (N+1, NX), (N, NU) */
    vd *k, *K;                 /* feedforward (N, NU), feedback (N, NU, NX) column-major */
    vd p[NP + NQ + 1], s[NX], low0[NU], high0[NU];
    vd J, J_new, mu, predicted;
    vd size, size_new;         /* J with the magnitudes of all costs */
    vd defect, hidden;         /* what the defects cost; the change of J that rounding of the states makes */
    vd largest[NU];            /* magnitude of the plan's inputs */
    vd alpha, stretch;         /* length of the last step, 0 at first; the one that two steps in a row suggest */
    vl settled; /* lanes whose first input has settled */
    vl pd; /* lanes whose backward pass found a positive definite Quu */
#if LIMITS
    limits c;
#endif
} lanes;

#if LIMITS
#define TOLERANCE_OF(m, w) (w)->c.tolerance
#define LOOSER(w) (w)->c.looser
static void press_stage(const limits *c, int64_t k, const vd *x, const vd *u, const vd *p, vd *out);
static void press_end(const limits *c, int64_t N, const vd *x, const vd *p, vd *out);
static void look(const mpc_problem *m, lanes *w);
#if RATES
static kinks no_kinks(void);
static void before_step(const mpc_problem *m, const lanes *w, int64_t k, const vd *x, const vd *u, const vd *Qu, kinks *v);
static void after_step(const mpc_problem *m, const lanes *w, int64_t k, const vd *x, const vd *u, vd H[NU][NU], const vd *d,
                       const vl *is_free, kinks *v);
static void follow(vd H[NU][NU], const vl *is_free, const kinks *v, int i, vd *b);
#endif
#else
#define TOLERANCE_OF(m, w) (m)->tolerance
#define LOOSER(w) 1.0
#endif

static inline vl all_lanes(void) { return vd_le(V(0.0), V(0.0)); }
static inline vl no_lanes(void) { return vd_lt(V(0.0), V(0.0)); }

static inline vd clip(vd a, vd low, vd high) { return vd_min(vd_max(a, low), high); }

/* The bounds of a stage's inputs. Where inputs before are out of bounds, rates may not be kept. */
static inline void bounds_at(const mpc_problem *m, const lanes *w, int64_t k, const vd *x, vd *low, vd *high) {
    (void)x;
    for (int a = 0; a < NU; ++a) low[a] = k ? V(m->low[a]) : w->low0[a], high[a] = k ? V(m->high[a]) : w->high0[a];
#if RATES
    for (int a = 0; a < NU && (k || !w->c.given); ++a) {
        if (rate_place[a] < 0) continue;
        vd before = x[rate_place[a]], lowest = clip(before - rate_down[a], low[a], high[a]);
        high[a] = clip(before + rate_up[a], low[a], high[a]), low[a] = lowest;
    }
#endif
}

#if LIMITS
/* The end of a rollout: keeps the cost J and its size as they are without the limits, and returns J with them. */
static vd add_prices(const mpc_problem *m, lanes *w, double weight, const vd *x, vd prices, vd price_size, vd J, vd *size) {
    vd price = weight * end_prices(&w->c, m->horizon, x + m->horizon * NX, w->p, w->c.h_new);
    w->c.base_new = J, w->c.base_size_new = *size;
    *size += price_size + vd_abs(price);
    return J + (prices + price);
}
#endif

/* x+ and J along (x, u) -> open-loop states from s; returns the cost, and sets its size. The inputs of lanes that are any
 * guess are made such that they change as they may. */
static vd rollout_open(const mpc_problem *m, lanes *w, vd *x, vd *u, vl any_guess, vd *size) {
    vd J = V(0.0), out[NX + 1];
    *size = V(0.0);
    double weight = 1.0;
#if LIMITS
    vd prices = V(0.0), price_size = V(0.0);
#endif
    for (int i = 0; i < NX; ++i) x[i] = w->s[i];
    (void)any_guess;
    for (int64_t k = 0; k < m->horizon; ++k, weight *= m->discount) {
#if RATES
        vd low[NU], high[NU];
        bounds_at(m, w, k, x + k * NX, low, high);
        for (int a = 0; a < NU; ++a) u[k * NU + a] = vd_select(any_guess, clip(u[k * NU + a], low[a], high[a]), u[k * NU + a]);
#endif
        gen_step(x + k * NX, u + k * NU, w->p, out);
        for (int i = 0; i < NX; ++i) x[(k + 1) * NX + i] = out[i];
        J += weight * out[NX];
        *size += weight * vd_abs(out[NX]);
#if LIMITS
        vd price = stage_prices(&w->c, k, x + k * NX, u + k * NU, w->p, w->c.h_new);
        prices += weight * price, price_size += weight * vd_abs(price);
#endif
    }
    gen_final(x + m->horizon * NX, w->p, out);
    *size += weight * vd_abs(out[0]);
#if LIMITS
    J += weight * out[0];
    return add_prices(m, w, weight, x, prices, price_size, J, size);
#else
    return J + weight * out[0];
#endif
}

/* The closed-loop rollout of a step of length alpha (per lane) into x_new, u_new; sets J_new, size_new. */
static void rollout(const mpc_problem *m, lanes *w, vd alpha) {
    vd J = V(0.0), size = V(0.0), out[NX + 1], *x = w->x_new;
    double weight = 1.0;
#if LIMITS
    vd prices = V(0.0), price_size = V(0.0);
#endif
    for (int i = 0; i < NX; ++i) x[i] = w->s[i];
    for (int64_t k = 0; k < m->horizon; ++k, weight *= m->discount) {
        const vd *K = w->K + k * NU * NX;
        vd dx[NX], *u = w->u_new + k * NU, low[NU], high[NU];
        bounds_at(m, w, k, x + k * NX, low, high);
        for (int i = 0; i < NX; ++i) dx[i] = x[k * NX + i] - w->x[k * NX + i];
        for (int a = 0; a < NU; ++a) {
            vd v = w->u[k * NU + a] + alpha * w->k[k * NU + a];
            /* No feedback at k = 0, where dx = 0: a derivative that is singular at s alone gives a K that is NaN. */
            for (int i = 0; i < NX && k; ++i) v += K[i * NU + a] * dx[i];
            u[a] = clip(v, low[a], high[a]);
        }
        gen_step(x + k * NX, u, w->p, out);
        for (int i = 0; i < NX; ++i) x[(k + 1) * NX + i] = out[i];
        J += weight * out[NX];
        size += weight * vd_abs(out[NX]);
#if LIMITS
        vd price = stage_prices(&w->c, k, x + k * NX, u, w->p, w->c.h_new);
        prices += weight * price, price_size += weight * vd_abs(price);
#endif
    }
    gen_final(x + m->horizon * NX, w->p, out);
    w->J_new = J + weight * out[0];
    w->size_new = size + weight * vd_abs(out[0]);
#if LIMITS
    w->J_new = add_prices(m, w, weight, x, prices, price_size, w->J_new, &w->size_new);
#endif
}

/* H = L D L' of a matrix, in place: 1/D on the diagonal, L below it. Clears lanes that are not positive definite. */
static inline void factorise(vd H[NU][NU], vl *pd) {
    for (int j = 0; j < NU; ++j) {
        vd scaled[NU], d = H[j][j]; /* row j of L, times D */
        for (int l = 0; l < j; ++l) {
            scaled[l] = H[j][l];
            H[j][l] *= H[l][l];
            d -= H[j][l] * scaled[l];
        }
        vl ok = vd_lt(V(0.0), d);
        *pd &= ok;
        H[j][j] = 1.0 / vd_select(ok, d, V(1.0));
        for (int i = j + 1; i < NU; ++i) /* column j of L, times D, as the rows below expect it */
            for (int l = 0; l < j; ++l) H[i][j] -= H[j][l] * H[i][l];
    }
}

/* b <- H^-1 b with the factors of H. */
static INLINE void substitute(vd H[NU][NU], vd b[NU]) {
    for (int i = 0; i < NU; ++i)
        for (int l = 0; l < i; ++l) b[i] -= H[i][l] * b[l];
    for (int i = NU - 1; i >= 0; --i) {
        b[i] *= H[i][i];
        for (int l = i + 1; l < NU; ++l) b[i] -= H[l][i] * b[l];
    }
}

/* The first pass of box_qp as it is where no bound is in any lane's way, without its masks; returns whether it was. */
static inline int unbounded_qp(vd H[NU][NU], const vd g[NU], const vd low[NU], const vd high[NU], vd d[NU],
                               vl is_free[NU], vd F[NU][NU]) {
    vl definite = all_lanes(), bound = no_lanes();
    for (int i = 0; i < NU; ++i) {
        d[i] = -g[i];
        is_free[i] = all_lanes();
        for (int j = 0; j < NU; ++j) F[i][j] = H[i][j];
    }
    factorise(F, &definite);
    substitute(F, d);
    for (int i = 0; i < NU; ++i) {
        bound |= (vd_le(V(0.0), low[i]) & vd_lt(V(0.0), g[i])) | (vd_le(high[i], V(0.0)) & vd_lt(g[i], V(0.0)));
        bound |= vd_lt(d[i], low[i]) | vd_lt(high[i], d[i]);
    }
    return !vl_any(bound | ~definite);
}

/* min q(d) = 1/2 d'Hd + g'd, low <= d <= high (low <= 0 <= high) by projected Newton steps from d = 0. Returns which
 * inputs are free of their bounds and the factors of that part of H (identity elsewhere). */
static void box_qp(vd H[NU][NU], const vd g[NU], const vd low[NU], const vd high[NU], vd d[NU], vl is_free[NU],
                   vd F[NU][NU], vl *pd) {
    if (NU > 1 && unbounded_qp(H, g, low, high, d, is_free, F)) return;
    vl finished = no_lanes(), definite = all_lanes();
    for (int i = 0; i < NU; ++i) d[i] = V(0.0);
    for (int pass = 0; pass < 4 * NU + 4; ++pass) {
        vd slope[NU], b[NU], trial[NU];
        vl any_bound = no_lanes(), clipped = no_lanes();
        for (int i = 0; i < NU; ++i) {
            slope[i] = g[i];
            for (int j = 0; j < NU; ++j) slope[i] += H[i][j] * d[j];
            vl held = (vd_le(d[i], low[i]) & vd_lt(V(0.0), slope[i])) | (vd_le(high[i], d[i]) & vd_lt(slope[i], V(0.0)));
            is_free[i] = pass ? (is_free[i] & finished) | (~held & ~finished) : ~held;
            any_bound |= ~is_free[i];
            b[i] = vd_select(is_free[i], -slope[i], V(0.0));
        }
        for (int i = 0; i < NU; ++i)
            for (int j = 0; j < NU; ++j) F[i][j] = vd_select(is_free[i] & is_free[j], H[i][j], V(i == j ? 1.0 : 0.0));
        definite = all_lanes();
        factorise(F, &definite);
        substitute(F, b);
        for (int i = 0; i < NU; ++i) {
            trial[i] = clip(d[i] + b[i], low[i], high[i]);
            clipped |= vd_ne(trial[i], d[i] + b[i]);
            if (NU == 1) is_free[i] &= ~clipped;
        }
        if (NU == 1) { /* clipping the minimiser of a parabola gives the constrained one */
            d[0] = trial[0];
            break;
        }
        /* Halve the step, along its projection, until q falls enough. */
        vd t = V(1.0), expected = V(0.0), change = V(0.0);
        for (int halving = 0; halving < 12; ++halving) {
            vd fall = V(0.0);
            expected = V(0.0);
            for (int i = 0; i < NU; ++i) {
                vd step_i = trial[i] - d[i], curvature = V(0.0);
                for (int j = 0; j < NU; ++j) curvature += H[i][j] * (trial[j] - d[j]);
                expected -= slope[i] * step_i;
                fall -= step_i * (slope[i] + 0.5 * curvature);
            }
            vl shorten = vd_lt(fall, 0.1 * expected) & ~finished & definite;
            if (!vl_any(shorten)) break;
            t = vd_select(shorten, 0.5 * t, t);
            for (int i = 0; i < NU; ++i) trial[i] = vd_select(shorten, clip(d[i] + t * b[i], low[i], high[i]), trial[i]);
        }
        /* Done: the minimum without bounds, or a step that is small against the whole. */
        for (int i = 0; i < NU; ++i) {
            d[i] = vd_select(finished, d[i], trial[i]);
            change -= g[i] * d[i];
        }
        finished |= ~(any_bound | clipped) | vd_le(expected, 1e-12 * change) | ~definite;
        if (!vl_any(~finished)) break;
    }
    *pd &= definite;
}

#if !STAGE_CONVEX || !TERMINAL_CONVEX
#define JACOBI_SWEEPS 10 /* at most; four or five do */
#define JACOBI_TOLERANCE 1e-14 /* of elements off the diagonal, relative to the largest of all */

/* One Jacobi rotation of A that makes A[p][q] vanish; E, whose columns become eigenvectors, is rotated along. */
static inline void rotate(int n, vd A[NZ][NZ], vd E[NZ][NZ], int p, int q, vl wanted) {
    vd d = A[q][q] - A[p][p], twice = 2.0 * A[p][q];
    vd t = twice / (vd_abs(d) + vd_sqrt(d * d + twice * twice));
    t = vd_select(wanted, vd_select(vd_lt(d, V(0.0)), -t, t), V(0.0));
    vd c = 1.0 / vd_sqrt(1.0 + t * t), s = t * c;
    for (int k = 0; k < n; ++k) {
        vd a = A[k][p], b = A[k][q], e = E[k][p], f = E[k][q];
        A[k][p] = c * a - s * b, A[k][q] = s * a + c * b;
        E[k][p] = c * e - s * f, E[k][q] = s * e + c * f;
    }
    for (int k = 0; k < n; ++k) {
        vd a = A[p][k], b = A[q][k];
        A[p][k] = c * a - s * b, A[q][k] = s * a + c * b;
    }
}

/* H <- H - sum of min(l, 0) v v' over the eigenvalues l of the n x n upper triangle H and their eigenvectors v: its
 * positive semidefinite part. A positive definite matrix is left as it is. */
static inline void project(int n, vd *H) {
    vd A[NZ][NZ], E[NZ][NZ], scale = V(0.0);
    vl definite = all_lanes();
    for (int j = 0; j < n; ++j) { /* A <- L with H = L D L', for its signs */
        for (int i = j; i < n; ++i) {
            A[i][j] = H[TRI(j, i)];
            for (int l = 0; l < j; ++l) A[i][j] -= A[i][l] * E[j][l];
        }
        definite &= vd_lt(V(0.0), A[j][j]);
        for (int i = j + 1; i < n; ++i) E[i][j] = A[i][j] / A[j][j];
    }
    if (!vl_any(~definite)) return;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) {
            A[i][j] = H[i < j ? TRI(i, j) : TRI(j, i)];
            E[i][j] = V(i == j ? 1.0 : 0.0);
            scale = vd_max(scale, vd_abs(A[i][j]));
        }
    for (int sweep = 0; sweep < JACOBI_SWEEPS; ++sweep) {
        vl any = no_lanes();
        for (int p = 0; p < n; ++p)
            for (int q = p + 1; q < n; ++q) {
                vl wanted = vd_lt(JACOBI_TOLERANCE * scale, vd_abs(A[p][q]));
                if (!vl_any(wanted)) continue; /* lanes that have nothing to rotate are left alone in either case */
                rotate(n, A, E, p, q, wanted);
                any |= wanted;
            }
        if (!vl_any(any)) break;
    }
    for (int l = 0; l < n; ++l) {
        vd lift = vd_select(definite, V(0.0), vd_max(-A[l][l], V(0.0)));
        for (int j = 0; j < n; ++j)
            for (int i = 0; i <= j; ++i) H[TRI(i, j)] += lift * E[i][l] * E[j][l];
    }
}
#endif

/* The quadratic models of T and of Q(x, u) = L + gamma V(f(x, u)); of costs that need not be convex, made so. */
static void expand_final(const vd *x, const vd *p, vd *out) {
    gen_final_expand(x, p, out);
#if !TERMINAL_CONVEX
    project(NX, out + NX);
#endif
}

static void expand_stage(const vd *x, const vd *u, const vd *x_next, const vd *Vx, const vd *Vxx, const vd *discount,
                         const vd *p, vd *out) {
#if STAGE_CONVEX
    gen_q(x, u, x_next, Vx, Vxx, discount, p, out);
#else
    vd stage[NZ + NZ * (NZ + 1) / 2];
    gen_stage_expand(x, u, p, stage);
    project(NZ, stage + NZ);
    gen_q(x, u, x_next, Vx, Vxx, discount, stage, p, out);
#endif
}

/* The curvature of f, which Gauss-Newton leaves out, makes full steps too short or too long. Two steps k, k+ in a row
 * show by how much, k+ = (1 - alpha a) k, and 1 / a would have reached the end were it the same in all directions:
 * Barzilai and Borwein, doi:10.1093/imanum/8.1.141, in the metric of H. square = k'Hk, change = k'H(k - k+). */
static vd stretch(vd alpha, vd square, vd change) {
    vl known = vd_lt(V(0.0), alpha) & vd_lt(V(0.0), change);
    return vd_select(known, clip(alpha * square / change, V(SHORTEST_STEP), V(LONGEST_STEP)), V(1.0));
}

/* Riccati recursion along (x, u): gains k, K, the predicted decrease of J, and where Quu was positive definite. */
static void backward(const mpc_problem *m, lanes *w) {
    vd Vx[NX], Vxx[NT], out[NX + NX + NU + NT + NU * NX + NU * NU];
    int64_t N = m->horizon;
    expand_final(w->x + N * NX, w->p, out);
#if LIMITS
    if (vl_any(~vd_lt(w->J, V(INFINITY)))) look(m, w);
    press_end(&w->c, N, w->x + N * NX, w->p, out);
#endif
    for (int i = 0; i < NX; ++i) Vx[i] = out[i];
    for (int i = 0; i < NT; ++i) Vxx[i] = out[NX + i];
    double weight = 1.0;
    for (int64_t k = 1; k < N; ++k) weight *= m->discount;
    vd discount = V(m->discount), square = V(0.0), change = V(0.0);
#if RATES
    kinks kink = no_kinks();
#endif
    w->pd = all_lanes();
    vd predicted = V(0.0), defect = V(0.0), largest[NU];
    double ratio[NU][NU], ridge[NU];
    int guessed = vl_any(~vd_lt(w->J, V(INFINITY))); /* trajectories that came without a cost need not obey the model */
    for (int a = 0; a < NU; ++a) {
        largest[a] = V(0.0);
        ridge[a] = RIDGE / m->unit[a];
        for (int b = 0; b < NU; ++b) ratio[a][b] = m->unit[b] / m->unit[a];
    }
    for (int64_t k = N - 1; k >= 0; --k, weight /= m->discount) {
        const vd *u = w->u + k * NU;
        expand_stage(w->x + k * NX, u, w->x + (k + 1) * NX, Vx, Vxx, &discount, w->p, out);
#if LIMITS
        press_stage(&w->c, k, w->x + k * NX, u, w->p, out + NX);
#endif
        const vd *Qx = out + NX, *Qu = Qx + NX, *Qxx = Qu + NU, *Qux = Qxx + NT, *Quu = Qux + NU * NX;
        for (int i = 0; i < NX && guessed; ++i) defect += weight * m->discount * vd_abs(Vx[i] * out[i]);
        /* Regularised in proportion to Quu: independent of units, and positive definite for any Quu from mu = 1 on. An
         * input without any curvature goes to its bounds, or stays if nothing depends on it. */
        vd H[NU][NU], d[NU], F[NU][NU];
#if RATES
        before_step(m, w, k, w->x + k * NX, u, Qu, &kink);
        const vd *g = kink.g, *low = kink.low, *high = kink.high;
#else
        vd low[NU], high[NU];
        const vd *g = Qu;
#endif
        for (int a = 0; a < NU; ++a) {
            vd size = V(0.0);
            for (int b = 0; b < NU; ++b) {
                H[a][b] = Quu[b * NU + a];
                size += ratio[a][b] * vd_abs(H[a][b]);
            }
            H[a][a] += (w->mu + RIDGE) * size + (ridge[a] * vd_abs(Qu[a]) + TINY);
            largest[a] = vd_max(largest[a], vd_abs(u[a]));
#if !RATES
            low[a] = (k ? V(m->low[a]) : w->low0[a]) - u[a];
            high[a] = (k ? V(m->high[a]) : w->high0[a]) - u[a];
#endif
        }
        vl is_free[NU];
        box_qp(H, g, low, high, d, is_free, F, &w->pd);
#if RATES
        after_step(m, w, k, w->x + k * NX, u, H, d, is_free, &kink);
#endif
        vd *K = w->K + k * NU * NX;
        for (int i = 0; i < NX; ++i) {
            vd b[NU];
            for (int a = 0; a < NU; ++a) b[a] = vd_select(is_free[a], -Qux[i * NU + a], V(0.0));
#if RATES
            follow(H, is_free, &kink, i, b);
#endif
            substitute(F, b);
            for (int a = 0; a < NU; ++a) K[i * NU + a] = b[a];
        }
        /* Value of the step: V <- Q(dx, d + K dx). */
        vd half = V(0.0), slope = V(0.0), gradient[NU], M[NU][NX];
        for (int a = 0; a < NU; ++a) {
            vd Quud = V(0.0);
            for (int b = 0; b < NU; ++b) Quud += Quu[b * NU + a] * d[b];
            vd before = w->k[k * NU + a], size = weight * H[a][a] * before;
            square += size * before;
            change += size * (before - d[a]);
            w->k[k * NU + a] = d[a];
            gradient[a] = g[a] + Quud;
            slope += g[a] * d[a];
            half += 0.5 * d[a] * Quud;
            for (int i = 0; i < NX; ++i) {
                M[a][i] = Qux[i * NU + a];
                for (int b = 0; b < NU; ++b) M[a][i] += Quu[b * NU + a] * K[i * NU + b];
            }
        }
        predicted -= weight * (slope + half);
        for (int i = 0; i < NX; ++i) {
            Vx[i] = Qx[i];
            for (int a = 0; a < NU; ++a) Vx[i] += K[i * NU + a] * gradient[a] + Qux[i * NU + a] * d[a];
            for (int j = i; j < NX; ++j) {
                vd v = Qxx[TRI(i, j)];
                for (int a = 0; a < NU; ++a) v += K[i * NU + a] * M[a][j] + Qux[i * NU + a] * K[j * NU + a];
                Vxx[TRI(i, j)] = v;
            }
        }
    }
    vd hidden = V(0.0);
    for (int i = 0; i < NX; ++i) hidden += vd_abs(Vx[i] * w->s[i]);
    w->predicted = predicted, w->defect = defect, w->hidden = (ROUNDING * N) * hidden;
    for (int a = 0; a < NU; ++a) w->largest[a] = largest[a];
    w->stretch = stretch(w->alpha, square, change);
}

/* The starts that go on after a race to costs J: the cheapest, then the cheapest of those that differ from all chosen
 * before; places that are left go to the cheapest of the others. */
static inline void choose_finalists(const double *J, int64_t n, int64_t *chosen) {
    int64_t n_chosen = 0;
    for (int distinct = 1; distinct >= 0; --distinct)
        while (n_chosen < FINALISTS(n)) {
            int64_t best = -1;
            for (int64_t i = 0; i < n; ++i) {
                int fits = !distinct || J[i] < INFINITY;
                for (int64_t c = 0; c < n_chosen && fits; ++c) {
                    double other = J[chosen[c]];
                    fits = i != chosen[c] && (!distinct || fabs(J[i] - other) > DISTINCT * fabs(other));
                }
                if (fits && (best < 0 || J[i] < J[best])) best = i;
            }
            if (best < 0) break;
            chosen[n_chosen++] = best;
        }
}

/* The start of a share of the candidates: its cheapest one, which keeps the starts different. */
static inline int64_t start_of(int64_t share, int64_t n_starts, const double *J, int64_t n_candidates) {
    int64_t cheapest = share * n_candidates / n_starts;
    for (int64_t c = cheapest; c < (share + 1) * n_candidates / n_starts; ++c)
        if (J[c] < J[cheapest]) cheapest = c;
    return cheapest;
}

/* Whether a plan of cost J goes before the best so far: a converged one that is as good goes before one that is not. */
static inline int goes_before(double J, int converged, double best, int best_converged) {
    double slack = BEATEN * (best < 0 ? -best : best);
    int closer = converged && !best_converged && J < best + slack;
    return closer || J < best - (converged == best_converged ? 0.0 : slack) || !(best < INFINITY);
}

/* Takes over the new trajectory where the mask says so. */
static void accept(const mpc_problem *m, lanes *w, vl mask) {
    w->J = vd_select(mask, w->J_new, w->J);
    w->size = vd_select(mask, w->size_new, w->size);
#if LIMITS
    w->c.base = vd_select(mask, w->c.base_new, w->c.base);
    w->c.base_size = vd_select(mask, w->c.base_size_new, w->c.base_size);
#endif
    if (!vl_any(~mask)) {
        vd *x = w->x, *u = w->u;
        w->x = w->x_new, w->u = w->u_new;
        w->x_new = x, w->u_new = u;
#if LIMITS
        vd *h = w->c.h;
        w->c.h = w->c.h_new, w->c.h_new = h;
#endif
        return;
    }
    if (!vl_any(mask)) return;
    for (int64_t k = 0; k < m->horizon * NU; ++k) w->u[k] = vd_select(mask, w->u_new[k], w->u[k]);
    for (int64_t k = 0; k < (m->horizon + 1) * NX; ++k) w->x[k] = vd_select(mask, w->x_new[k], w->x[k]);
#if LIMITS
    for (int64_t k = 0; k < (m->horizon + 1) * LIMITS; ++k) w->c.h[k] = vd_select(mask, w->c.h_new[k], w->c.h[k]);
#endif
}

/* Lanes that Gauss-Newton, where it creeps, has brought near enough to a solution. */
static vl acceptable(const mpc_problem *m, const lanes *w) {
    return w->settled & vd_le(w->predicted, ACCEPTABLE * m->tolerance * w->size);
}

/* One iteration: backward pass, line search, regularisation. Lanes that are not wanted may be left where they are.
 * Returns which lanes have converged, moved, and stalled. */
static void iterate(const mpc_problem *m, lanes *w, vl wanted, vl *converged, vl *moved, vl *stalled) {
    backward(m, w);
    /* The cost can be flat where the policy is not: the first input must have settled too. */
    vl settled = all_lanes();
    vd far = vd_max(w->stretch, V(1.0)); /* how much farther than the step the solution is */
    for (int a = 0; a < NU; ++a) {
        double range = m->high[a] - m->low[a], least = range < INFINITY ? LEAST_INPUT * range : 0.0;
        vd size = clip(w->largest[a], V(least), V(range));
        settled &= vd_le(far * vd_abs(w->k[a]), LOOSER(w) * INPUT_TOLERANCE * size);
    }
    vl at_rest = vd_le(w->size, w->hidden); /* nothing but rounding is left of the cost */
    settled |= at_rest;
    /* A step found with heavy regularisation promises little without being near a solution. */
    settled &= w->pd & vd_le(w->mu, V(1.0));
    w->settled = settled;
    /* A point is a solution when the model holds and the quadratic model promises no further decrease. */
    vl small = settled & vd_lt(vd_abs(w->J), V(INFINITY)) &
               (vd_le(w->predicted, TOLERANCE_OF(m, w) * w->size) | at_rest);
    vl open = all_lanes();
    vd alpha = vd_select(vd_le(w->mu, V(0.0)) & ~small, w->stretch, V(1.0));
    w->alpha = V(0.0);
    *moved = no_lanes();
    for (int trial = 0; trial < MAX_BACKTRACKS; ++trial) {
        rollout(m, w, alpha);
        vl better = vd_lt(w->J_new, w->J - ARMIJO * alpha * vd_max(w->predicted, V(0.0)));
        better &= vd_lt(vd_abs(w->J_new), V(INFINITY)) & open & w->pd;
        accept(m, w, better);
        w->alpha = vd_select(better, alpha, w->alpha);
        *moved |= better;
        open &= ~better & w->pd & ~small; /* the last step of a solution is tried once, at full length */
        if (!vl_any(open & wanted)) break;
        alpha = vd_select(vd_lt(V(1.0), alpha), V(1.0), 0.4 * alpha);
    }
    /* A warm start that obeys the model is as good as a rollout, only its cost is not known before the step. */
    vl nearly = vd_le(w->defect, DEFECT_TOLERANCE * TOLERANCE_OF(m, w) * w->size) &
                vd_le(w->predicted, TOLERANCE_OF(m, w) * w->size);
    *converged = small | (nearly & *moved & settled);
    vd less = vd_select(vd_lt(V(MU_MIN), 0.2 * w->mu), 0.2 * w->mu, V(0.0));
    vd more = vd_select(vd_lt(V(0.0), w->mu), 8.0 * w->mu, V(MU_FIRST));
    w->mu = vd_select(*moved, less, more);
    *stalled = ~*moved & ~vd_lt(w->mu, V(MU_MAX));
}
