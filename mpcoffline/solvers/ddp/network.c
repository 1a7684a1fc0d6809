/* The network of T as loops over its weights, which are parameters: A_k row by row at p + network[k].weights, as
 * a_k = A_k h_{k-1} + b_k, h_k = sigma(a_k), sigma(a) = a / sqrt(1 + a^2); one output y = A h, its bias left to others. */

/* The derivative of one result by 8 inputs, or by what is left of them: a row times a matrix. */
static INLINE void network_tile(int width, int columns, const vd *row, const vd *D, vd *out) {
    vd s[8];
    for (int c = 0; c < width; ++c) s[c] = V(0.0);
    for (int j = 0; j < columns; ++j, D += NETWORK_INPUTS)
        for (int c = 0; c < width; ++c) s[c] += row[j] * D[c];
    for (int c = 0; c < width; ++c) out[c] = s[c];
}

/* Results of the hidden layers one behind the other, and 1 / sqrt(1 + a^2) of each; returns y. */
static NOINLINE vd network_forward(const vd *z, const vd *p, vd *h, vd *norm) {
    const vd *in = z;
    for (int k = 0; k < NETWORK_LAYERS; ++k) {
        network_layer layer = network[k];
        const vd *A = p + layer.weights, *b = p + layer.biases;
        for (int i = 0; i < layer.rows; ++i, A += layer.columns) {
            vd a = b[i];
            for (int j = 0; j < layer.columns; ++j) a += A[j] * in[j];
            norm[i] = vd_rsqrt(1.0 + a * a), h[i] = a * norm[i];
        }
        in = h, h += layer.rows, norm += layer.rows;
    }
    const vd *A = p + network[NETWORK_LAYERS].weights;
    vd y = V(0.0);
    for (int j = 0; j < network[NETWORK_LAYERS].columns; ++j) y += A[j] * in[j];
    return y;
}

/* y, and its gradient and the upper triangle of its Hessian by z. With G = da / dz of a hidden result a, and v = dy / dh:
 * the gradient is sum v sigma' G over the first layer, the Hessian sum v sigma'' G G' over all. */
static NOINLINE void network_expand(const vd *z, const vd *p, vd *out) {
    enum { N = NETWORK_INPUTS };
    vd h[NETWORK_HIDDEN], norm[NETWORK_HIDDEN], G[NETWORK_HIDDEN * N], D[NETWORK_WIDEST * N], v[NETWORK_WIDEST];
    vd slope[NETWORK_WIDEST], *gradient = out + 1, *hessian = gradient + N;
    int first = 0;
    out[0] = network_forward(z, p, h, norm);
    for (int k = 0; k < NETWORK_LAYERS; first += network[k++].rows) {
        const vd *A = p + network[k].weights;
        for (int i = 0; i < network[k].rows; ++i, A += network[k].columns) {
            vd *g = G + (first + i) * N;
            if (!k) {
                for (int c = 0; c < N; ++c) g[c] = A[c];
                continue;
            }
            int c = 0;
            for (; c + 8 <= N; c += 8) network_tile(8, network[k].columns, A, D + c, g + c);
            if (N % 8) network_tile(N % 8, network[k].columns, A, D + c, g + c);
        }
        for (int i = 0; i < network[k].rows; ++i) {
            vd r = norm[first + i], cubed = r * r * r;
            for (int c = 0; c < N; ++c) D[i * N + c] = cubed * G[(first + i) * N + c];
        }
    }
    for (int c = 0; c < N; ++c) gradient[c] = V(0.0);
    for (int c = 0; c < N * (N + 1) / 2; ++c) hessian[c] = V(0.0);
    for (int j = 0; j < network[NETWORK_LAYERS].columns; ++j) v[j] = p[network[NETWORK_LAYERS].weights + j];
    for (int k = NETWORK_LAYERS - 1; k >= 0; --k) {
        network_layer layer = network[k];
        first -= layer.rows;
        for (int i = 0; i < layer.rows; ++i) {
            vd r = norm[first + i], *g = G + (first + i) * N, *to = hessian;
            slope[i] = v[i] * (r * r * r);
            vd bend = -3.0 * slope[i] * (r * h[first + i]); /* sigma'' = -3 a r^5, a = h / r */
            for (int b = 0; b < N; ++b) {
                vd scaled = bend * g[b];
                for (int a = 0; a <= b; ++a) *to++ += scaled * g[a];
                if (!k) gradient[b] += slope[i] * g[b];
            }
        }
        if (!k) break;
        const vd *A = p + layer.weights;
        for (int j = 0; j < layer.columns; ++j) v[j] = V(0.0);
        for (int i = 0; i < layer.rows; ++i, A += layer.columns)
            for (int j = 0; j < layer.columns; ++j) v[j] += slope[i] * A[j];
    }
}
