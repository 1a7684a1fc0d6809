/* The outer loop of limits: multipliers, weights, and when a problem is solved or cannot be. See constraints.h. */

#if LIMITS > RATES
#define FIRST_TOLERANCE 1e-3 /* of the first minimisation; a tenth after each, down to the tolerance */
#define WARM_TOLERANCE 1e-5  /* likewise, from a plan */
#define MOST_INNER 60        /* iterations of a minimisation, before it may be of use to know the multipliers better */
#else /* there are no multipliers: one minimisation is all */
#define FIRST_TOLERANCE 0.0
#define WARM_TOLERANCE 0.0
#define MOST_INNER INFINITY
#endif
#define FIRST_WEIGHT 1e2     /* times a spread of a stage's costs over that of h */
#define GROWTH 5.0           /* of the weight of an element that came closer by less than */
#define CLOSER 4.0
#define STUCK 2.0            /* times in a row: then its square */
#define LARGEST_WEIGHT 1e7   /* times the first: a hard limit that is not near its solution then, cannot be kept */
#define UNAFFORDABLE 30.0    /* times all other costs there and what candidates differ by: no more is paid for hard limits */
#define STILL_OPEN 0.05      /* of what is paid for hard limits: what promises more when it is cut short, was not done */
#define FEW_INNER 12         /* iterations of a minimisation in which those that are stuck cost more than all else */
#define RELAXED 10.0         /* what a weight falls by from plan to plan, at least, */
#define STIFF 100.0          /* to no more than this times the first one: stiffer problems are slow */
#define FEASIBLE 1e-6        /* scales of an element: it counts as kept */
#define PAID 1e-7            /* of the costs' size: what is paid too much for soft ones */
#define LEAST_SCALE 1e-2     /* of what the candidates say of an element: it is measured by no less */
#define MOST_WEIGHT 1e250    /* so that units of 1e-200 do not lead to infinities */
#define SURVEYED 4           /* stages of each candidate whose h say how large it is */
#define MOST_CANDIDATES 64

/* The weight to begin with, of that of the plan before and of the first one. */
static double relaxed(double rho, double first) {
    double less = rho / RELAXED < STIFF * first ? rho / RELAXED : STIFF * first;
    return less > first ? less : first;
}

/* Weights that others are computed from. */
static void weigh(limits *c) {
    for (int j = 0; j < LIMITS; ++j) {
        c->inverse[j] = 1.0 / c->rho[j];
        c->ratio[j] = V(0.0);
        if (limit_l2[j] > 0.0) c->ratio[j] = 2.0 * limit_l2[j] / (2.0 * limit_l2[j] + c->rho[j]);
    }
}

/* What the limits add to the expansions of a stage's Q, from Qx on, and of T. */
static void press_stage(const limits *c, int64_t k, const vd *x, const vd *u, const vd *p, vd *out) {
    vd y[STAGE_LIMITS + 1], dy[STAGE_LIMITS + 1], more[NX + NU + NT + NU * NX + NU * NU];
    const vd *lambda = c->multiplier + k * LIMITS, *h = c->h + k * LIMITS;
    vl any = no_lanes();
    for (int j = 0; j < STAGE_LIMITS; ++j) {
        int imposed = is_imposed(c, k, j);
        y[j] = imposed ? pressure(c, j, lambda[j], h[j]) : V(0.0);
        dy[j] = imposed ? slope_of_pressure(c, j, lambda[j], h[j]) : V(0.0);
        any |= vd_lt(V(0.0), y[j]);
    }
    if (!vl_any(any)) return; /* most stages are far from their limits */
    gen_limits(x, u, y, dy, p, more);
    for (int i = 0; i < NX + NU + NT + NU * NX + NU * NU; ++i) out[i] += more[i];
}

static void press_end(const limits *c, int64_t N, const vd *x, const vd *p, vd *out) {
    vd y[LIMITS - END_FIRST + 1], dy[LIMITS - END_FIRST + 1], more[NX + NT];
    const vd *lambda = c->multiplier + N * LIMITS, *h = c->h + N * LIMITS;
    if (END_FIRST == LIMITS) return;
    for (int j = END_FIRST; j < LIMITS; ++j) {
        y[j - END_FIRST] = pressure(c, j, lambda[j], h[j]);
        dy[j - END_FIRST] = slope_of_pressure(c, j, lambda[j], h[j]);
    }
    gen_limits_end(x, y, dy, p, more);
    for (int i = 0; i < NX + NT; ++i) out[i] += more[i];
}

/* h along x, u, which came without it. */
static void look(const mpc_problem *m, lanes *w) {
    for (int64_t k = 0; k < m->horizon; ++k) gen_h(w->x + k * NX, w->u + k * NU, w->p, w->c.h + k * LIMITS);
    gen_h_end(w->x + m->horizon * NX, w->p, w->c.h + m->horizon * LIMITS + END_FIRST);
}

/* What h is measured by along a trajectory: how far it moves there, within a part of what the candidates made of it. */
static void own_scales(const mpc_problem *m, const limits *c, vd *own) {
    for (int j = 0; j < LIMITS; ++j) {
        vd low = V(INFINITY), high = V(-INFINITY);
        for (int64_t k = 0; k <= m->horizon; ++k) {
            if (k < m->horizon ? j >= STAGE_LIMITS : j < END_FIRST) continue;
            low = vd_min(low, c->h[k * LIMITS + j]), high = vd_max(high, c->h[k * LIMITS + j]);
        }
        own[j] = j < STAGE_LIMITS ? clip(high - low, LEAST_SCALE * c->scale[j], c->scale[j]) : c->scale[j];
    }
}

/* The costs with the prices phi; by how many scales the hard limit is violated that is so most, which one that is
 * (k LIMITS + j), and by how many the given state violates limits that no input can change. */
static void appraise(const mpc_problem *m, const lanes *w, vd *cost, vd *violation, vd *worst, vd *now) {
    const limits *c = &w->c;
    double weight = 1.0;
    vd own[LIMITS];
    own_scales(m, c, own);
    *cost = c->base, *violation = *worst = *now = V(0.0);
    for (int64_t k = 0; k <= m->horizon; ++k, weight *= m->discount)
        for (int j = k < m->horizon ? 0 : END_FIRST; j < (k < m->horizon ? STAGE_LIMITS : LIMITS); ++j) {
            vd h = c->h[k * LIMITS + j], in_scales = h / own[j];
            if (!k && j >= END_FIRST) continue;
            if (limit_l1[j] < INFINITY) {
                *cost += weight * due(j, h);
            } else if (!k && !limit_by_input[j]) {
                *now = vd_max(*now, in_scales);
            } else {
                *worst = vd_select(vd_lt(*violation, in_scales), V((double)(k * LIMITS + j)), *worst);
                *violation = vd_max(*violation, in_scales);
            }
        }
    vl known = vd_lt(vd_abs(w->J), V(INFINITY));
    *cost = vd_select(known, *cost, w->J);
    *violation = vd_select(known, *violation, V(INFINITY));
}

/* How far each element is from |y - lambda| = 0, which is feasibility and complementarity in one, in scales; and what soft
 * ones may cost too much for it. */
static vd distances(const mpc_problem *m, const lanes *w, vd *off) {
    const limits *c = &w->c;
    vd overpaid = V(0.0), own[LIMITS];
    double weight = 1.0;
    own_scales(m, c, own);
    for (int j = 0; j < LIMITS; ++j) off[j] = V(0.0);
    for (int64_t k = 0; k <= m->horizon; ++k, weight *= m->discount)
        for (int j = k < m->horizon ? 0 : END_FIRST; j < (k < m->horizon ? STAGE_LIMITS : LIMITS); ++j) {
            if (!is_imposed(c, k, j)) continue;
            vd lambda = c->multiplier[k * LIMITS + j], y = pressure(c, j, lambda, c->h[k * LIMITS + j]);
            vd apart = vd_abs(y - lambda) * c->inverse[j];
            off[j] = vd_max(off[j], apart);
            if (limit_l1[j] < INFINITY) overpaid += weight * apart * vd_max(y, lambda);
        }
    for (int j = 0; j < LIMITS; ++j) off[j] = off[j] / own[j];
    return overpaid;
}

/* Lanes whose plan is as near to a solution as it must be. */
static vl is_near(const lanes *w, const vd *off, vd overpaid) {
    vl near = vd_le(overpaid, PAID * w->size);
    for (int j = 0; j < LIMITS; ++j) near &= vd_le(off[j], V(FEASIBLE));
    return near;
}

/* What is paid for hard limits: nothing at a solution; for convex problems it is a lower bound of what keeping them costs. */
static vd paid_for_hard(const mpc_problem *m, const lanes *w) {
    const limits *c = &w->c;
    vd paid = V(0.0);
    double weight = 1.0;
    for (int64_t k = 0; k <= m->horizon; ++k, weight *= m->discount)
        for (int j = k < m->horizon ? 0 : END_FIRST; j < (k < m->horizon ? STAGE_LIMITS : LIMITS); ++j)
            if (is_imposed(c, k, j) && !(limit_l1[j] < INFINITY))
                paid += weight * psi(c, j, c->multiplier[k * LIMITS + j], c->h[k * LIMITS + j]);
    return paid;
}

/* What the costs of candidates differ by, which the first weights were made of. */
static vd spread_of_costs(const mpc_problem *m, const limits *c) {
    vd costs = V(0.0);
    for (int j = 0; j < LIMITS; ++j) costs = vd_max(costs, c->first_rho[j] * c->scale[j] * c->scale[j]);
    return costs * ((double)m->horizon / FIRST_WEIGHT);
}

/* Of two plans the one that keeps its limits, or violates them less: 1 the first, -1 the other, 0 either. */
static int keeps_better(double violation, double other) {
    int kept = violation <= FEASIBLE, other_kept = other <= FEASIBLE;
    if (kept || other_kept) return kept - other_kept;
    return violation < other ? 1 : -1;
}

/* J of the trajectory with the multipliers as they are now. */
static void price_again(const mpc_problem *m, lanes *w, vl changed) {
    limits *c = &w->c;
    vd J = c->base, size = c->base_size;
    double weight = 1.0;
    for (int64_t k = 0; k <= m->horizon; ++k, weight *= m->discount) {
        vd sum = V(0.0);
        for (int j = k < m->horizon ? 0 : END_FIRST; j < (k < m->horizon ? STAGE_LIMITS : LIMITS); ++j) {
            vd h = c->h[k * LIMITS + j];
            if (is_imposed(c, k, j)) sum += psi(c, j, c->multiplier[k * LIMITS + j], h);
            else if (j < END_FIRST) sum += due(j, h);
        }
        J += weight * sum, size += weight * vd_abs(sum);
    }
    w->J = vd_select(changed, J, w->J);
    w->size = vd_select(changed, size, w->size);
}

/* Where hard limits cannot be kept, all of them become as dear as the dearest: which of them is violated by how much depends
 * on their scales alone, not on when each was found to be stuck. */
static void balance(limits *c, vl lost) {
    vd dearest = V(0.0);
    if (!vl_any(lost)) return;
    for (int j = 0; j < LIMITS; ++j)
        if (!(limit_l1[j] < INFINITY)) dearest = vd_max(dearest, c->rho[j] / c->first_rho[j]);
    for (int j = 0; j < LIMITS; ++j)
        if (!(limit_l1[j] < INFINITY)) c->rho[j] = vd_select(lost, dearest * c->first_rho[j], c->rho[j]);
}

/* Lanes whose minimisation has ended get new multipliers, and go on; converged and stalled are left to those that are
 * through. Those that cannot be solved have one more minimisation, with the weights in balance, after which they are
 * returned. While hard limits that are stuck cost more than all else, minimisations are short and not exact. */
static vl tighten(const mpc_problem *m, lanes *w, vl *converged, vl *stalled) {
    limits *c = &w->c;
    vd off[LIMITS];
    c->inner += 1.0;
    vd most = vd_select(vd_lt(V(0.0), c->dominated), V(FEW_INNER), V(MOST_INNER));
    vl capped = vd_le(most, c->inner) & ~(*converged | *stalled);
    vl ended = (*converged | *stalled | capped) & vd_lt(vd_abs(w->J), V(INFINITY));
    if (!vl_any(ended)) return no_lanes();
    vd overpaid = distances(m, w, off);
    vl near = is_near(w, off, overpaid), lost = no_lanes(), held = no_lanes();
    vl told = ended & ~near & vd_lt(V(1.0), c->dominated);
    vd paid = paid_for_hard(m, w), others = w->size - vd_abs(paid);
    vl dear = vd_lt(UNAFFORDABLE * (others + spread_of_costs(m, c)), paid);
    /* A minimisation that is cut short while it may still be rid of what it pays, tells nothing of its limits. */
    vl open = capped & vd_lt(STILL_OPEN * paid, w->predicted);
    vl through = ended & near & vd_le(c->tolerance, V(m->tolerance)) & ~capped;
    vl go_on = ended & ~through;
    for (int64_t k = 0; k <= m->horizon; ++k)
        for (int j = k < m->horizon ? 0 : END_FIRST; j < (k < m->horizon ? STAGE_LIMITS : LIMITS); ++j) {
            vd *lambda = c->multiplier + k * LIMITS + j;
            if (is_imposed(c, k, j)) *lambda = vd_select(go_on, pressure(c, j, *lambda, c->h[k * LIMITS + j]), *lambda);
        }
    for (int j = 0; j < LIMITS; ++j) {
        vl slow = go_on & vd_lt(V(FEASIBLE), off[j]) & vd_lt(c->before[j] / CLOSER, off[j]);
        c->stuck[j] = vd_select(go_on, vd_select(slow, c->stuck[j] + 1.0, V(0.0)), c->stuck[j]);
        vl often = vd_le(V(STUCK), c->stuck[j]) & ~open;
        if (!(limit_l1[j] < INFINITY)) {
            held |= often;
            lost |= slow & ~open & ((often & dear) | vd_lt(LARGEST_WEIGHT * c->first_rho[j], c->rho[j]));
        }
        vd more = vd_select(often, V(GROWTH * GROWTH), V(GROWTH)) * c->rho[j];
        c->rho[j] = vd_select(slow & ~told & (often | ~capped), more, c->rho[j]);
        c->before[j] = vd_select(go_on, off[j], c->before[j]);
    }
    vd next = vd_select(near, V(m->tolerance), vd_max(0.1 * c->tolerance, V(m->tolerance)));
    held &= vd_lt(others, paid);
    balance(c, lost & ~told);
    weigh(c);
    c->dominated = vd_select(go_on, vd_select(lost, V(2.0), vd_select(held, V(1.0), V(0.0))), c->dominated);
    c->tolerance = vd_select(go_on & ~(capped | held), next, c->tolerance);
    c->looser = vd_sqrt(c->tolerance / m->tolerance);
    c->inner = vd_select(go_on, V(0.0), c->inner);
    w->mu = vd_select(go_on, V(0.0), w->mu);
    w->alpha = vd_select(go_on, V(0.0), w->alpha);
    price_again(m, w, go_on);
    *converged &= through;
    *stalled &= ~go_on;
    return told;
}

/* What the candidates of a problem say of the sizes of its costs and limits: n of them so far. */
typedef struct survey {
    int64_t n;
    double *J, *h, *chosen; /* (MOST_CANDIDATES), (LIMITS, OF_EACH), (OF_EACH) */
} survey;

#define OF_EACH (SURVEYED * MOST_CANDIDATES)
#define SURVEY_SIZE ((LIMITS + 1) * OF_EACH + MOST_CANDIDATES)

static survey survey_in(double *memory) {
    survey s;
    s.n = 0, s.J = memory, s.chosen = memory + MOST_CANDIDATES, s.h = s.chosen + OF_EACH;
    return s;
}

static void note(const mpc_problem *m, const lanes *w, survey *s) {
    for (int l = 0; l < LANES; ++l, ++s->n) {
        s->J[s->n] = LANE(w->c.base_new, l);
        for (int i = 0; i < SURVEYED; ++i) {
            int64_t k = (i + 1) * m->horizon / SURVEYED, last = m->horizon;
            for (int j = 0; j < LIMITS; ++j) {
                int64_t at = j >= STAGE_LIMITS ? last : j < END_FIRST && k == last ? last - 1 : !k && j >= END_FIRST ? last : k;
                s->h[j * OF_EACH + s->n * SURVEYED + i] = LANE(w->c.h_new[at * LIMITS + j], l);
            }
        }
    }
}

/* Sorts numbers; there are few. */
static void sort(double *v, int64_t n) {
    for (int64_t gap = n / 2; gap > 0; gap /= 2)
        for (int64_t i = gap; i < n; ++i) {
            double kept = v[i];
            int64_t k = i;
            for (; k >= gap && v[k - gap] > kept; k -= gap) v[k] = v[k - gap];
            v[k] = kept;
        }
}

/* The distance from one quantile to another; of all, or the size, where there is none. */
static double spread(double *v, int64_t n, double from, double to) {
    if (!n) return 1.0;
    sort(v, n);
    double found = v[(int64_t)(to * (n - 1))] - v[(int64_t)(from * (n - 1))];
    if (!(found > 0.0)) found = v[n - 1] - v[0];
    if (!(found > 0.0)) found = fabs(v[0]);
    return found > 0.0 && found < INFINITY ? found : 1.0;
}

/* First weights and scales, (LIMITS) each, of what the cheaper half of the candidates do. */
static void conclude(const mpc_problem *m, survey *s, double *first_rho, double *scale) {
    int64_t n = 0;
    for (int64_t c = 0; c < s->n; ++c)
        if (s->J[c] - s->J[c] == 0.0) s->chosen[n++] = s->J[c];
    double costs = spread(s->chosen, n, 0.0, 0.5), dearest = n ? s->chosen[(n - 1) / 2] : 0.0;
    for (int j = 0; j < LIMITS; ++j) {
        n = 0;
        for (int64_t i = 0; i < s->n * SURVEYED; ++i) {
            double h = s->h[j * OF_EACH + i];
            if (s->J[i / SURVEYED] <= dearest && h - h == 0.0) s->chosen[n++] = h;
        }
        scale[j] = spread(s->chosen, n, 0.25, 0.75);
        first_rho[j] = FIRST_WEIGHT * costs / (double)m->horizon / (scale[j] * scale[j]);
        if (!(first_rho[j] < MOST_WEIGHT)) first_rho[j] = MOST_WEIGHT;
        if (!(first_rho[j] > 1.0 / MOST_WEIGHT)) first_rho[j] = 1.0 / MOST_WEIGHT;
    }
}
