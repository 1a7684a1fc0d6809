/* Limits h_j(x, u) <= 0 by an augmented Lagrangian: what core.c adds to the costs of a stage.
 *
 * A limit costs phi(s) = l1 s + l2 s^2 for s = max(h, 0), and a hard one, with l1 = infinity, whatever it takes. With a
 * multiplier lambda and a weight rho, both in the (discounted) units of a stage's cost,
 *
 *   psi(h) = max over y >= 0 of  y h - phi*(y) - (y - lambda)^2 / (2 rho),     phi*(y) = max(y - l1, 0)^2 / (4 l2),
 *
 * which is at y = 0 | t | l1 + (t - l1) 2 l2 / (2 l2 + rho)  for  t = lambda + rho h <= 0 | <= l1 | above. It is smooth, never
 * more than phi, and where y = lambda its derivative y is that of phi. So lambda <- y after each minimisation of the costs
 * with psi leads to a minimum of the costs with phi: Hestenes 1969, Powell 1969; Rockafellar, doi:10.1287/moor.1.2.97, for
 * phi. Elements are in three blocks: of constraints along the horizon, of state bounds, and of constraints at the end.
 *
 * Included after generated code that defines LIMITS, STAGE_LIMITS (of the first two blocks), END_FIRST (of the first), the
 * arrays limit_l1, limit_l2, limit_by_input and limit_is_rate (of hard limits to what an input may change by in a step:
 * core.c never leaves these, so they press on nothing, and are only looked at), and
 *   gen_h(x, u, p, out):      h [STAGE_LIMITS]
 *   gen_h_end(x, p, out):     h [LIMITS - END_FIRST]
 *   gen_limits(x, u, y, dy, p, out):  h_z'y and h_z' diag(dy) h_z, in the order of gen_q from Qx on
 *   gen_limits_end(x, y, dy, p, out): likewise, as gen_final_expand
 */
#include <stdint.h>

#ifndef LANES
#define LANES 1
#define LANE(v, l) (v)
#else
#define LANE(v, l) (v)[l]
#endif

#define MULTIPLIER_ROWS(N) ((N) + 4) /* multipliers of the stages 0 ... N, weights, first weights, scales */

struct survey;

typedef struct {
    vd *h, *h_new, *multiplier; /* (N+1, LIMITS): along the trajectory, along the one that is tried */
    vd rho[LIMITS], first_rho[LIMITS], scale[LIMITS]; /* weights; what h is measured by */
    vd inverse[LIMITS], ratio[LIMITS];                /* 1 / rho, 2 l2 / (2 l2 + rho) */
    vd before[LIMITS], stuck[LIMITS];                 /* how far each was from its solution, in scales; how long so far */
    vd base, base_new, base_size, base_size_new;      /* costs without psi */
    vd tolerance, looser;                             /* of this minimisation, and times what of the first input */
    vd inner;                                         /* its iterations */
    vd dominated;                                     /* 1: by hard limits that are stuck; 2: which cannot be kept */
    struct survey *asked;                             /* what rollouts of candidates are noted in, or NULL */
    vd violation;                                     /* of the hard limit that is violated most, in scales */
    int given;                                        /* whether the first input is imposed */
} limits;

#if RATES
/* What the Riccati recursion knows of inputs that are at their rates; see rates.c. */
typedef struct {
    vd up[NU], down[NU], place[NU]; /* of V at the next stage: by what its slope is larger above, smaller below this input */
    vd rise[NU], fall[NU];          /* slopes of Q above and below */
    vd low[NU], high[NU], g[NU];    /* bounds of a step, and the slope it looks at */
    vl stops[NU];                   /* inputs that go no farther than the kink */
    vl follows[NU];                 /* and those that move with the one before */
} kinks;
#endif

/* Others cannot be changed by any input, or are kept anyway: they are reported, not imposed. */
static inline int is_imposed(const limits *c, int64_t k, int j) {
    return !limit_is_rate[j] && (k || (limit_by_input[j] && !c->given));
}

/* phi; zero for a hard one. */
static inline vd due(int j, vd h) {
    vd s = vd_max(h, V(0.0));
    return limit_l1[j] < INFINITY ? limit_l1[j] * s + limit_l2[j] * s * s : V(0.0);
}

static inline vd pressure(const limits *c, int j, vd lambda, vd h) {
    vd t = vd_max(lambda + c->rho[j] * h, V(0.0));
    if (!(limit_l1[j] < INFINITY)) return t;
    return vd_select(vd_lt(V(limit_l1[j]), t), limit_l1[j] + (t - limit_l1[j]) * c->ratio[j], t);
}

static inline vd slope_of_pressure(const limits *c, int j, vd lambda, vd h) {
    vd t = lambda + c->rho[j] * h, dy = vd_select(vd_lt(V(0.0), t), c->rho[j], V(0.0));
    if (!(limit_l1[j] < INFINITY)) return dy;
    return vd_select(vd_lt(V(limit_l1[j]), t), c->rho[j] * c->ratio[j], dy);
}

static inline vd psi(const limits *c, int j, vd lambda, vd h) {
    vd y = pressure(c, j, lambda, h), d = y - lambda, sum = y * h - 0.5 * d * d * c->inverse[j];
    if (!(limit_l2[j] > 0.0)) return sum;
    vd above = vd_max(y - limit_l1[j], V(0.0));
    return sum - above * above * (limit_l2[j] > 0.0 ? 0.25 / limit_l2[j] : 0.0);
}

/* What limits cost at a stage, as far as it can be changed or is paid for anyway; their values go to h. */
static inline vd stage_prices(const limits *c, int64_t k, const vd *x, const vd *u, const vd *p, vd *all) {
    vd sum = V(0.0), *h = all + k * LIMITS;
    const vd *lambda = c->multiplier + k * LIMITS;
    gen_h(x, u, p, h);
    for (int j = 0; j < STAGE_LIMITS; ++j) {
        if (is_imposed(c, k, j)) sum += psi(c, j, lambda[j], h[j]);
        else if (j < END_FIRST) sum += due(j, h[j]);
    }
    return sum;
}

static inline vd end_prices(const limits *c, int64_t N, const vd *x, const vd *p, vd *all) {
    vd sum = V(0.0), *h = all + N * LIMITS;
    const vd *lambda = c->multiplier + N * LIMITS;
    gen_h_end(x, p, h + END_FIRST);
    for (int j = END_FIRST; j < LIMITS; ++j) sum += psi(c, j, lambda[j], h[j]);
    return sum;
}
