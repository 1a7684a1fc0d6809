/* LANES doubles that share an instruction: GCC and Clang vector extensions, in plain C. */
#include <math.h>

/* As many as the processor's registers hold: wider vectors spill, and GCC compares them one by one. */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double vd __attribute__((vector_size(8 * LANES)));
typedef long long vl __attribute__((vector_size(8 * LANES)));

#define RESTRICT restrict
#define NOINLINE __attribute__((noinline))
#define INLINE inline __attribute__((always_inline))

static inline vd V(double a) { return a - (vd){0}; }
static inline vd vd_select(vl mask, vd a, vd b) { return (vd)((mask & (vl)a) | (~mask & (vl)b)); }
static inline vl vd_lt(vd a, vd b) { return a < b; }
static inline vl vd_le(vd a, vd b) { return a <= b; }
static inline vl vd_ne(vd a, vd b) { return a != b; }
static inline vd vd_min(vd a, vd b) { return vd_select(a < b, a, b); }
static inline vd vd_max(vd a, vd b) { return vd_select(a > b, a, b); }
static inline vd vd_abs(vd a) { return vd_select(a < 0.0, -a, a); }
static inline int vl_any(vl mask) {
#if defined(__AVX__) && LANES == 4 /* one instruction instead of a dozen */
    return !__builtin_ia32_ptestz256(mask, mask);
#else
    long long any = 0;
    for (int l = 0; l < LANES; ++l) any |= mask[l];
    return any != 0;
#endif
}

/* 1 / sqrt(a) of normal positive numbers, a unit in the last place off: Newton's method, from a first guess by half the
 * exponent. A root and a division take four times as long. NaN of infinity. */
static INLINE vd vd_rsqrt(vd a) {
    typedef unsigned long long vu __attribute__((vector_size(8 * LANES)));
    vd y = (vd)(0x5fe6eb50c7b537a9ULL - ((vu)a >> 1)), h = 0.5 * a;
    for (int i = 0; i < 3; ++i) y *= 1.5 - h * y * y;
    return y + y * (0.5 - h * y * y);
}

static inline vd vd_bool(vl mask) { return vd_select(mask, V(1.0), V(0.0)); }

#define LANEWISE(name, call) \
    static inline vd name(vd a) { vd r; for (int l = 0; l < LANES; ++l) r[l] = call(a[l]); return r; }
#define LANEWISE2(name, call) \
    static inline vd name(vd a, vd b) { vd r; for (int l = 0; l < LANES; ++l) r[l] = call(a[l], b[l]); return r; }

LANEWISE(vd_sqrt, sqrt) LANEWISE(vd_exp, exp) LANEWISE(vd_log, log) LANEWISE(vd_log1p, log1p) LANEWISE(vd_expm1, expm1)
LANEWISE(vd_sin, sin) LANEWISE(vd_cos, cos) LANEWISE(vd_tan, tan) LANEWISE(vd_asin, asin) LANEWISE(vd_acos, acos)
LANEWISE(vd_atan, atan) LANEWISE(vd_sinh, sinh) LANEWISE(vd_cosh, cosh) LANEWISE(vd_tanh, tanh) LANEWISE(vd_asinh, asinh)
LANEWISE(vd_acosh, acosh) LANEWISE(vd_atanh, atanh) LANEWISE(vd_floor, floor) LANEWISE(vd_ceil, ceil) LANEWISE(vd_erf, erf)
LANEWISE2(vd_pow, pow) LANEWISE2(vd_atan2, atan2) LANEWISE2(vd_hypot, hypot) LANEWISE2(vd_fmod, fmod)
LANEWISE2(vd_copysign, copysign) LANEWISE2(vd_remainder, remainder)
