/* What core.c needs of vector.h, for one problem at a time in plain C99, which is C++ too. Masks are 0 and -1. */
#include <math.h>

typedef double vd;
typedef int vl;

#define V(a) ((vd)(a))
#define NOINLINE
#ifdef __cplusplus
#define RESTRICT
#else
#define RESTRICT restrict
#endif
#define INLINE inline
#define vl_any(mask) (mask)
static inline vd vd_select(vl mask, vd a, vd b) { return mask ? a : b; }
static inline vl vd_lt(vd a, vd b) { return -(a < b); }
static inline vl vd_le(vd a, vd b) { return -(a <= b); }
static inline vl vd_ne(vd a, vd b) { return -(a != b); }
static inline vd vd_min(vd a, vd b) { return a < b ? a : b; }
static inline vd vd_max(vd a, vd b) { return a > b ? a : b; }
#define vd_bool(mask) ((mask) ? 1.0 : 0.0) /* a function that no model uses is a warning of clang's */
#define vd_abs fabs
#define vd_sqrt sqrt
#define vd_rsqrt(a) (1.0 / sqrt(a))
#define vd_exp exp
#define vd_log log
#define vd_log1p log1p
#define vd_expm1 expm1
#define vd_sin sin
#define vd_cos cos
#define vd_tan tan
#define vd_asin asin
#define vd_acos acos
#define vd_atan atan
#define vd_sinh sinh
#define vd_cosh cosh
#define vd_tanh tanh
#define vd_asinh asinh
#define vd_acosh acosh
#define vd_atanh atanh
#define vd_floor floor
#define vd_ceil ceil
#define vd_erf erf
#define vd_pow pow
#define vd_atan2 atan2
#define vd_hypot hypot
#define vd_fmod fmod
#define vd_copysign copysign
#define vd_remainder remainder
