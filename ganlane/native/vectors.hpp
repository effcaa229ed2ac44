// A vector of LANES numbers, one of each of LANES environments, and the functions of it that the kernel needs.
//
// GCC's and Clang's vector extensions: + - * / and comparisons work number by number.

#pragma once

#include <stdint.h>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#ifndef LANES
#define LANES 4
#endif

typedef float Float __attribute__((vector_size(4 * LANES)));
typedef int32_t Mask __attribute__((vector_size(4 * LANES)));  // -1 true, 0 false

#define INLINE static inline __attribute__((always_inline))

INLINE Float filled(float number) { return number - Float{}; }
INLINE Mask none() { return Mask{}; }
INLINE Float choose(Mask mask, Float yes, Float no) { return mask ? yes : no; }
// a < b ? a : b, and a > b ? a : b. x86 has instructions for exactly that, which GCC 12 makes a comparison and a choice
// of: with them, and fewer copies of gates, `gan` took 4 % less time.
#if defined(__AVX512F__) && LANES == 16
INLINE Float smaller(Float a, Float b) { return (Float)_mm512_min_ps((__m512)a, (__m512)b); }
INLINE Float larger(Float a, Float b) { return (Float)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX__) && LANES == 8
INLINE Float smaller(Float a, Float b) { return (Float)_mm256_min_ps((__m256)a, (__m256)b); }
INLINE Float larger(Float a, Float b) { return (Float)_mm256_max_ps((__m256)a, (__m256)b); }
#elif defined(__SSE2__) && LANES == 4
INLINE Float smaller(Float a, Float b) { return (Float)_mm_min_ps((__m128)a, (__m128)b); }
INLINE Float larger(Float a, Float b) { return (Float)_mm_max_ps((__m128)a, (__m128)b); }
#else
INLINE Float smaller(Float a, Float b) { return a < b ? a : b; }
INLINE Float larger(Float a, Float b) { return a > b ? a : b; }
#endif
INLINE Float between(Float a, float low, float high) { return smaller(larger(a, filled(low)), filled(high)); }
// -most to most; AVX-512 has an instruction for that.
INLINE Float within(Float a, float most) {
#if defined(__AVX512DQ__) && LANES == 16
    return (Float)_mm512_range_ps((__m512)a, (__m512)filled(most), 2);  // the smaller of the sizes, with the sign of a
#else
    return between(a, -most, most);
#endif
}
INLINE Float absolute(Float a) { return (Float)((Mask)a & 0x7fffffff); }

// a b + c with one rounding, on every instruction set: where there is no such instruction, the product is exact in
// double precision, and the sum is rounded to odd there, so that the second rounding is that of the exact number
// (Boldo and Melquiond 2008).
INLINE Float fused(Float a, Float b, Float c) {
#if defined(__AVX512F__) && LANES == 16
    return (Float)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif defined(__FMA__) && LANES == 8
    return (Float)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#elif defined(__ARM_NEON) && LANES == 4
    return (Float)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
#else
    typedef double Wide __attribute__((vector_size(8 * LANES)));
    typedef int64_t Bits __attribute__((vector_size(8 * LANES)));
    Wide product = __builtin_convertvector(a, Wide) * __builtin_convertvector(b, Wide);
    Wide addend = __builtin_convertvector(c, Wide), sum = product + addend;
    Wide part = sum - product, error = (product - (sum - part)) + (addend - part);
    // One unit in the last place towards the exact sum, where it is not exact and the last bit is even.
    typedef uint64_t Unsigned __attribute__((vector_size(8 * LANES)));
    Bits last = (Bits)sum & 1, away = (Bits)(((Unsigned)sum ^ (Unsigned)error) >> 63);
    Bits rounded_to_odd = (Bits)sum + ((1 - 2 * away) & (error != 0.0) & (last - 1));
    return __builtin_convertvector((Wide)rounded_to_odd, Float);
#endif
}

// To the nearest integer, half to even, below 2^22: the sum has no bits left for a fraction.
INLINE Float rounded(Float a) { return (a + 12582912.0f) - 12582912.0f; }

INLINE bool any(Mask mask) {
#if defined(__AVX512F__) && LANES == 16
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask) != 0;
#elif defined(__AVX__) && LANES == 8
    return _mm256_movemask_ps((__m256)mask) != 0;
#elif defined(__SSE2__) && LANES == 4
    return _mm_movemask_ps((__m128)mask) != 0;
#else
    int32_t found = 0;
    for (int lane = 0; lane < LANES; lane++) found |= mask[lane];
    return found != 0;
#endif
}

// Sine and cosine: the angle less the nearest multiple of pi/2 (in three parts), then Cephes' polynomials.
// Below pi/4, where nearly all angles are, nothing is subtracted and nothing exchanged: that is left out.
INLINE Float sine_series(Float r) {
    Float z = r * r;
    return ((z * -1.9515295891e-4f + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * r + r;
}

INLINE Float cosine_series(Float r) {
    Float z = r * r;
    return ((z * 2.443315711809948e-5f - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z - 0.5f * z + 1.0f;
}

static __attribute__((noinline)) void sincos_of_large(Float angle, Float& sine, Float& cosine) {
    Float quarter = rounded(angle * 0.636619772367581f);
    Float r = ((angle - quarter * 1.5703125f) - quarter * 4.837512969970703125e-4f) - quarter * 7.54978995489188e-8f;
    Float s = sine_series(r), c = cosine_series(r);
    Mask k = __builtin_convertvector(quarter, Mask);
    Mask odd = (k & 1) != 0;
    sine = (Float)((Mask)choose(odd, c, s) ^ ((k & 2) << 30));
    cosine = (Float)((Mask)choose(odd, s, c) ^ (((k + 1) & 2) << 30));
}

INLINE Mask is_large(Float angle) { return rounded(angle * 0.636619772367581f) != 0.0f; }

INLINE void sincos_of(Float angle, Float& sine, Float& cosine) {
    if (any(is_large(angle))) return sincos_of_large(angle, sine, cosine);
    sine = sine_series(angle), cosine = cosine_series(angle);
}

INLINE Float sine_of(Float angle) {
    if (!any(is_large(angle))) return sine_series(angle);
    Float sine, cosine;
    sincos_of_large(angle, sine, cosine);
    return sine;
}

// Arctangent: Cephes' polynomial below tan(pi/8), by atan x = pi/4 + atan((x-1)/(x+1)) and pi/2 - atan(1/x) above.
INLINE Float arctangent_series(Float r) {
    Float z = r * r;
    return (((z * 8.05374449538e-2f - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f) * z * r + r;
}

static __attribute__((noinline)) Float arctangent_of_large(Float number) {
    Float a = absolute(number);
    Mask large = a > 2.414213562373095f, middle = (a > 0.4142135623730950f) & ~large;
    Float top = choose(large, filled(-1.0f), choose(middle, a - 1.0f, a));
    Float bottom = choose(large, a, choose(middle, a + 1.0f, filled(1.0f)));
    Float start = choose(large, filled(1.5707963267948966f), choose(middle, filled(0.7853981633974483f), filled(0.0f)));
    Float angle = start + arctangent_series(top / bottom);
    return (Float)((Mask)angle ^ ((Mask)number & (Mask)filled(-0.0f)));
}

INLINE Float arctangent(Float number) {
    if (any(absolute(number) > 0.4142135623730950f)) return arctangent_of_large(number);
    return arctangent_series(number);
}

// Natural logarithm of a positive normal number (Cephes).
INLINE Float logarithm(Float x) {
    Mask bits = (Mask)x;
    Float exponent = __builtin_convertvector((bits >> 23) - 126, Float);
    Float m = (Float)((bits & 0x7fffff) | 0x3f000000);  // in [0.5, 1)
    Mask low = m < 0.707106781186547524f;
    exponent = choose(low, exponent - 1.0f, exponent);
    m = choose(low, m + m, m) - 1.0f;
    Float z = m * m;
    Float p = (((7.0376836292e-2f * m - 1.1514610310e-1f) * m + 1.1676998740e-1f) * m - 1.2420140846e-1f) * m;
    p = (((p + 1.4249322787e-1f) * m - 1.6668057665e-1f) * m + 2.0000714765e-1f) * m - 2.4999993993e-1f;
    p = (p * m + 3.3333331174e-1f) * m * z + exponent * -2.12194440e-4f - 0.5f * z;
    return m + p + exponent * 0.693359375f;
}

// Square root, rounded exactly.
INLINE Float root(Float a) {
#if defined(__AVX512F__) && LANES == 16
    return (Float)_mm512_sqrt_ps((__m512)a);
#elif defined(__AVX__) && LANES == 8
    return (Float)_mm256_sqrt_ps((__m256)a);
#elif defined(__SSE2__) && LANES == 4
    return (Float)_mm_sqrt_ps((__m128)a);
#else
    Float roots;
    for (int lane = 0; lane < LANES; lane++) roots[lane] = __builtin_sqrtf(a[lane]);
    return roots;
#endif
}
