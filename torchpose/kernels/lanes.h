// Vectors with a lane for each problem; those of doubles fill the widest registers of the processor at hand.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#ifdef _OPENMP
#include <omp.h>
#endif

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
#define INLINE static inline __attribute__((always_inline))
#define VECTOR(name, type) typedef type name __attribute__((vector_size(LANES * sizeof(type))))
VECTOR(F, float);
VECTOR(D, double);
VECTOR(J, int64_t);
VECTOR(M, int32_t);  // what a comparison says: all bits or none
VECTOR(B, uint8_t);

INLINE F all(float x) { return F{} + x; }
INLINE D all(double x) { return D{} + x; }
INLINE J all(int64_t x) { return J{} + x; }
INLINE M all(uint8_t x) { return M{} - (x != 0); }

template <class T, class S> INLINE T loaded(const S* p) {
    T x;
    memcpy(&x, p, sizeof x);
    return x;
}
INLINE F load(const float* p) { return loaded<F>(p); }
INLINE D load(const double* p) { return loaded<D>(p); }
INLINE J load(const int64_t* p) { return loaded<J>(p); }
INLINE M load(const uint8_t* p) { return __builtin_convertvector(loaded<B>(p), M) != 0; }

template <class T, class S> INLINE T gathered(const S* p, int64_t stride) {
    T x;
    for (int l = 0; l < LANES; ++l) x[l] = p[l * stride];
    return x;
}
INLINE F gather(const float* p, int64_t stride) { return gathered<F>(p, stride); }
INLINE D gather(const double* p, int64_t stride) { return gathered<D>(p, stride); }
INLINE J gather(const int64_t* p, int64_t stride) { return gathered<J>(p, stride); }
INLINE M gather(const uint8_t* p, int64_t stride) { return gathered<M>(p, stride) != 0; }

template <class S, class T> INLINE void store(S* p, T x) { memcpy(p, &x, sizeof x); }
template <class S, class T> INLINE void scatter(S* p, int64_t stride, T x) {
    for (int l = 0; l < LANES; ++l) p[l * stride] = x[l];
}
INLINE void scatter(uint8_t* p, int64_t stride, M x) { scatter<uint8_t, M>(p, stride, x & 1); }
INLINE void store(uint8_t* p, M x) { store(p, __builtin_convertvector(x & 1, B)); }

#define COMPARE(name, op) \
    INLINE M name(F x, F y) { return x op y; } \
    INLINE M name(D x, D y) { return __builtin_convertvector(x op y, M); } \
    INLINE M name(J x, J y) { return __builtin_convertvector(x op y, M); }
COMPARE(eq, ==) COMPARE(ne, !=) COMPARE(lt, <) COMPARE(le, <=) COMPARE(gt, >) COMPARE(ge, >=)

template <class T, class S> INLINE T to(S x) {
    if constexpr (std::is_same_v<S, M>) return __builtin_convertvector(x & 1, T);
    else if constexpr (std::is_same_v<T, M>) return ne(x, S{});
    else return __builtin_convertvector(x, T);
}

INLINE F select(M m, F x, F y) { return m ? x : y; }
INLINE M select(M m, M x, M y) { return m ? x : y; }
INLINE D select(M m, D x, D y) { return __builtin_convertvector(m, J) ? x : y; }
INLINE J select(M m, J x, J y) { return __builtin_convertvector(m, J) ? x : y; }

INLINE bool any(M m) {
    int32_t some = 0;
    for (int l = 0; l < LANES; ++l) some |= m[l];
    return some;
}

// as torch has them: not a number where one of the two is not
template <class T> INLINE T least(T x, T y) { return select(lt(x, y) | ne(x, x), x, y); }
template <class T> INLINE T most(T x, T y) { return select(gt(x, y) | ne(x, x), x, y); }

template <class T> INLINE T magnitude(T x) { return select(lt(x, T{}), -x, x); }

template <class T> INLINE T inverse(T x) { return (T{} + 1) / x; }

#define EACH(name, function) \
    INLINE F name(F x) { for (int l = 0; l < LANES; ++l) x[l] = std::function(x[l]); return x; } \
    INLINE D name(D x) { for (int l = 0; l < LANES; ++l) x[l] = std::function(x[l]); return x; }
EACH(root, sqrt) EACH(arctangent, atan) EACH(sine, sin) EACH(cosine, cos)

#define PAIRS(name, function) \
    INLINE F name(F x, F y) { for (int l = 0; l < LANES; ++l) x[l] = function(x[l], y[l]); return x; } \
    INLINE D name(D x, D y) { for (int l = 0; l < LANES; ++l) x[l] = function(x[l], y[l]); return x; }
// of the sign of the divisor, as in Python
template <class S> INLINE S modulus(S x, S y) {
    const S rest = std::fmod(x, y);
    return rest != 0 && (rest < 0) != (y < 0) ? rest + y : rest;
}
PAIRS(angle, std::atan2) PAIRS(length, std::hypot) PAIRS(power, std::pow) PAIRS(modulo, modulus)

// of the blocks of LANES problems, from the first up to the last: what is made for every function follows this file
static void solve(void* const* data, const int64_t* strides, int64_t batch, int64_t limit,
                  int64_t first, int64_t last);

extern "C" void kernel(void* const* data, const int64_t* strides, int64_t batch, int64_t limit,
                       int threads) {
    const int64_t blocks = (batch + LANES - 1) / LANES;
#ifdef _OPENMP
    if (threads > 1) {
#pragma omp parallel num_threads(threads)
        {
            const int64_t k = omp_get_thread_num(), n = omp_get_num_threads();
            solve(data, strides, batch, limit, blocks * k / n, blocks * (k + 1) / n);
        }
        return;
    }
#endif
    solve(data, strides, batch, limit, 0, blocks);
}
