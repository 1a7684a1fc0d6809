/* Layers of a model: products with constant matrices, and what follows each of their results alone. v holds a model's
 * results, d their derivatives by the NZ states and inputs, a row each. Rows of matrices come in fours, column by column
 * within each four, padded with zeros: so many sums are in registers at a time. */

#define NZ (NX + NU)

/* out = W in + b */
static void layer_values(const double *W, const double *b, int rows, int columns, const vd *in, vd *out) {
    for (int i = 0; i < rows; i += 4) {
        vd s[4];
        for (int r = 0; r < 4; ++r) s[r] = V(b[i + r]);
        for (int j = 0; j < columns; ++j, W += 4)
            for (int r = 0; r < 4; ++r) s[r] += W[r] * in[j];
        for (int r = 0; r < 4; ++r) out[i + r] = s[r];
    }
}

static INLINE void layer_tile(int width, const double *W, int columns, const vd *in, vd *out) {
    vd s[4][4];
    for (int r = 0; r < 4; ++r)
        for (int k = 0; k < width; ++k) s[r][k] = V(0.0);
    for (int j = 0; j < columns; ++j, W += 4, in += NZ)
        for (int r = 0; r < 4; ++r)
            for (int k = 0; k < width; ++k) s[r][k] += W[r] * in[k];
    for (int r = 0; r < 4; ++r)
        for (int k = 0; k < width; ++k) out[r * NZ + k] = s[r][k];
}

/* out = W in, of derivatives */
static void layer_slopes(const double *W, int rows, int columns, const vd *in, vd *out) {
    for (int i = 0; i < rows; i += 4, W += 4 * columns, out += 4 * NZ) {
        int k = 0;
        for (; k + 4 <= NZ; k += 4) layer_tile(4, W, columns, in + k, out + k);
        if (NZ % 4) layer_tile(NZ % 4, W, columns, in + k, out + k);
    }
}

/* out = W: derivatives that are numbers, as of a layer whose sources are affine in states and inputs */
static inline void layer_constants(const double *W, int rows, vd *out) {
    for (int i = 0; i < rows * NZ; ++i) out[i] = V(W[i]);
}

static inline void layer_gather(const int *index, int n, const vd *v, vd *out) {
    for (int i = 0; i < n; ++i) out[i] = v[index[i]];
}

static inline void layer_gather_slopes(const int *index, int n, const vd *d, vd *out) {
    for (int i = 0; i < n; ++i)
        for (int k = 0; k < NZ; ++k) out[i * NZ + k] = d[index[i] * NZ + k];
}

static inline void layer_scaled(vd slope, const vd *in, vd *out) {
    for (int k = 0; k < NZ; ++k) out[k] = slope * in[k];
}

static inline void layer_added(vd slope, const vd *in, vd *out) {
    for (int k = 0; k < NZ; ++k) out[k] += slope * in[k];
}

#ifdef LANES
/* exp and its relatives, all lanes at once; the rest of a network takes less time than the C library's would. Their
 * errors are a few units in the last place. */

#define LN2_HIGH 6.93147180369123816490e-01
#define LN2_LOW 1.90821492927058770002e-10

/* exp(a) = 2^k (1 + e), |e| < 0.42, for a within +-708; gives 2^k and e. NaN stays NaN. */
static inline vd split_exp(vd a, vd *power) {
    vd t = a * 1.44269504088896340736 + 6755399441055744.0, k = t - 6755399441055744.0; /* k in the last bits of t */
    vd r = (a - k * LN2_HIGH) - k * LN2_LOW;
    *power = (vd)(((vl)t << 52) + 0x3ff0000000000000LL);
    vd s = V(1.0 / 6227020800.0);
    s = s * r + 1.0 / 479001600.0, s = s * r + 1.0 / 39916800.0, s = s * r + 1.0 / 3628800.0;
    s = s * r + 1.0 / 362880.0, s = s * r + 1.0 / 40320.0, s = s * r + 1.0 / 5040.0, s = s * r + 1.0 / 720.0;
    s = s * r + 1.0 / 120.0, s = s * r + 1.0 / 24.0, s = s * r + 1.0 / 6.0, s = s * r + 0.5;
    return r + s * (r * r);
}

static inline vd within(vd a, double bound) {
    return vd_select(a < -bound, V(-bound), vd_select(a > bound, V(bound), a));
}

static inline vd layer_exp(vd a) {
    vd power, e = split_exp(within(a, 708.0), &power), y = power + power * e;
    return vd_select(a > 709.78, V(INFINITY), vd_select(a < -708.0, V(0.0), y));
}

static inline vd layer_expm1(vd a) {
    vd power, e = split_exp(within(a, 708.0), &power);
    return vd_select(a > 709.78, V(INFINITY), power * e + (power - 1.0));
}

static inline vd layer_tanh(vd a) {
    vd e = layer_expm1(2.0 * within(a, 20.0));
    return e / (e + 2.0);
}

#define vd_exp layer_exp
#define vd_expm1 layer_expm1
#define vd_tanh layer_tanh
#endif
