// Elementary functions of one number in each lane, with the facts that bounds need: derivatives, their ranges, and the
// points where f'(x) = a. The formulas are those of lyapnet/prover/elementary_functions.py. exp, expm1 and log1p have
// relative errors below 4 ε; the other functions are those of the C library.

#pragma once

#include <cmath>
#include <cstdint>
#include <initializer_list>

namespace {

#ifdef __AVX512F__
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t M __attribute__((vector_size(8 * LANES)));  // truth values, all bits 0 or all 1; or the bits of numbers

constexpr double EPSILON = 2.220446049250313e-16, TINY = 1e-300, FLOOR = TINY / EPSILON, PI = 3.141592653589793;
constexpr int MOST_STATIONARY = 10;

inline V splat(double value) { return V{} + value; }
inline V absolute(V x) { return (V)((M)x & INT64_MAX); }
inline V larger(V x, V y) { return (x > y) | (x != x) ? x : y; }    // nan if either is nan
inline V smaller(V x, V y) { return (x < y) | (x != x) ? x : y; }
inline V clamped(V x, V lo, V hi) { return smaller(larger(x, lo), hi); }
inline M finite(V x) { return absolute(x) <= 1.7976931348623157e308; }
inline M always() { return splat(0) == 0; }

template <double (*F)(double)>
V each(V x) {
    for (int i = 0; i < LANES; i++) x[i] = F(x[i]);
    return x;
}

inline V root(V x) { return each<std::sqrt>(x); }

struct Range {
    V low, high;
};

// elementary_functions._widened
inline Range widened(V low, V high) {
    const V room = 64 * EPSILON * larger(absolute(low), absolute(high)) + TINY;
    return {low - room, high + room};
}

// The maximum of A ε + m ε² over |ε| ≤ 1, for A ≥ 0
inline V parabola(V A, V m) {
    const M inner = -2 * m > A;
    return inner ? A * (A / (inner ? -4 * m : splat(1))) : A + m;
}

struct Exponential {
    V whole, less_one;  // eˣ and eˣ − 1
};

// eˣ = 2ᵏ eʳ with |r| ≤ ½ log 2, by the power series of eʳ − 1
inline Exponential exponential(V x) {
    const double LOG2_HIGH = 6.93147180369123816490e-01, LOG2_LOW = 1.90821492927058770002e-10, SHIFT = 0x1.8p52;
    const V inside = clamped(x, splat(-708), splat(709));
    const V shifted = inside * 1.4426950408889634 + SHIFT, k = shifted - SHIFT;
    const V r = (inside - k * LOG2_HIGH) - k * LOG2_LOW;
    V tail = splat(1 / 6227020800.0);
    const double over[] = {479001600, 39916800, 3628800, 362880, 40320, 5040, 720, 120, 24, 6, 2};
    for (double factorial : over) tail = tail * r + 1 / factorial;
    const V p = r + r * r * tail;
    const V scale = (V)(((M)shifted + 1023) << 52);  // the low bits of `shifted` are k
    const M overflows = x > 709;
    return {overflows ? splat(INFINITY) : scale + scale * p, overflows ? splat(INFINITY) : scale * p + (scale - 1)};
}

// log(1 + u) = 2 artanh(u/(2 + u)) for 0 ≤ u ≤ 1, by its series
inline V log_one_more(V u) {
    const V s = u / (2 + u), z = s * s;
    V tail = splat(1 / 37.0);
    for (int k = 35; k > 1; k -= 2) tail = tail * z + 1.0 / k;
    return 2 * s + 2 * s * z * tail;
}

struct Jet {
    V d[5];  // f and its derivatives, as many as bounds need
};

// Functions whose derivatives are monotone on each interval of their domain
template <class F>
struct Monotone {
    static constexpr bool SMOOTH = true;
    template <int ORDER>
    Range range(V lo, V hi) const {
        const V a = F().jet(lo).d[ORDER], b = F().jet(hi).d[ORDER];
        return widened(smaller(a, b), larger(a, b));
    }
    M defined(V, V) const { return always(); }
};

struct Exp : Monotone<Exp> {
    Jet jet(V v) const {
        const V e = exponential(v).whole;
        return {{e, e, e, e, e}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = each<std::log>(a), 1; }
};

struct Log : Monotone<Log> {
    Jet jet(V v) const {
        const V i = 1 / v;
        return {{each<std::log>(v), i, -i * i, 2 * i * i * i, -6 * (i * i) * (i * i)}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = 1 / a, 1; }
    M defined(V lo, V) const { return lo > 0; }
};

struct Log1p : Monotone<Log1p> {
    Jet jet(V v) const {
        const V i = 1 / (1 + v);
        return {{each<std::log1p>(v), i, -i * i, 2 * i * i * i, -6 * (i * i) * (i * i)}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = 1 / a - 1, 1; }
    M defined(V lo, V) const { return lo > -1; }
};

struct Sqrt : Monotone<Sqrt> {
    Jet jet(V v) const {
        const V s = root(v), i = 1 / s, i3 = i * i * i;
        return {{s, 0.5 * i, -0.25 * i3, 0.375 * i3 * i * i, -0.9375 * i3 * i3 * i}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = 1 / (4 * a * a), 1; }
    M defined(V lo, V) const { return lo > 0; }
};

struct Reciprocal : Monotone<Reciprocal> {
    Jet jet(V v) const {
        const V i = 1 / v, i2 = i * i;
        return {{i, -i2, 2 * i * i2, -6 * i2 * i2, 24 * i * i2 * i2}};
    }
    int stationary(V a, V lo, V, V *at) const {
        const V r = 1 / root(-a);
        return at[0] = lo < 0 ? -r : r, 1;
    }
    M defined(V lo, V hi) const { return (lo > 0) | (hi < 0); }
};

struct Logistic {
    V v, up, down, p, tanh_half;  // v, σ(v), σ(−v), σ'(v), tanh(v/2)
    V u;                          // e^{−|v|}

    explicit Logistic(V v) : v(v) {
        const Exponential e = exponential(-absolute(v));
        u = e.whole;
        const V large = 1 / (1 + u), small = u * large, t = -e.less_one * large;
        up = v < 0 ? small : large, down = v < 0 ? large : small;
        p = large * small;
        tanh_half = v < 0 ? -t : t;
    }
};

// elementary_functions._slope_range: the range of σ' on [lo, hi]
inline Range slope_range(V lo, V hi, V p_lo, V p_hi) {
    const Range ends = widened(smaller(p_lo, p_hi), larger(p_lo, p_hi));
    return {ends.low, (lo < 0) & (hi > 0) ? splat(0.25) + 64 * EPSILON * 0.25 : ends.high};
}

// elementary_functions._sigmoid_third_range
inline Range sigmoid_third(V lo, V hi, V p_lo, V p_hi) {
    const Range p = slope_range(lo, hi, p_lo, p_hi);
    const V top = larger(p.low, smaller(p.high, splat(1.0 / 12)));
    const V a = p.low - 6 * p.low * p.low, b = p.high - 6 * p.high * p.high, c = top - 6 * top * top;
    return widened(smaller(smaller(a, b), c), larger(larger(a, b), c));
}

inline V logit(V s) { return each<std::log>(s) - each<std::log1p>(-s); }

struct Sigmoid {
    static constexpr bool SMOOTH = false;  // the `apply` for Sigmoidal expands it, with shared powers of the argument

    Jet jet(const Logistic &l) const { return {{l.up, l.p, -l.p * l.tanh_half, l.p * (1 - 6 * l.p), splat(0)}}; }
    Jet jet(V v) const { return jet(Logistic(v)); }
    template <int ORDER>
    Range range(V lo, V hi, const Logistic &a, const Logistic &b) const {
        if (ORDER == 3) return sigmoid_third(lo, hi, a.p, b.p);
        const Range p = slope_range(lo, hi, a.p, b.p);
        V least = splat(INFINITY), most = splat(-INFINITY);
        for (V f : {p.low, p.high})
            for (V g : {12 * p.low - 1, 12 * p.high - 1})
                for (V t : {a.tanh_half, b.tanh_half})
                    least = smaller(f * g * t, least), most = larger(f * g * t, most);
        return widened(least, most);
    }
    int stationary(V a, V, V, V *at) const {
        const V s = 2 * a / (1 + root(larger(1 - 4 * a, splat(0))));
        at[0] = logit(s), at[1] = -at[0];
        return 2;
    }
    M defined(V, V) const { return always(); }
};

struct Softplus {
    static constexpr bool SMOOTH = false;

    Jet jet(const Logistic &l) const {
        return {{larger(l.v, splat(0)) + log_one_more(l.u), l.up, l.p, -l.p * l.tanh_half, splat(0)}};
    }
    Jet jet(V v) const { return jet(Logistic(v)); }
    template <int ORDER>
    Range range(V lo, V hi, const Logistic &a, const Logistic &b) const {
        if (ORDER == 4) return sigmoid_third(lo, hi, a.p, b.p);
        const double STEEPEST = 1.3169578969248166, EXTREME = 0.09622504486493764;  // σ'' is ∓1/(6√3) at ±log(2 + √3)
        const V x = -a.p * a.tanh_half, y = -b.p * b.tanh_half;
        V least = smaller(x, y), most = larger(x, y);
        least = (lo <= STEEPEST) & (hi >= STEEPEST) ? splat(-EXTREME) : least;
        most = (lo <= -STEEPEST) & (hi >= -STEEPEST) ? splat(EXTREME) : most;
        return widened(least, most);
    }
    int stationary(V a, V, V, V *at) const { return at[0] = logit(a), 1; }
    M defined(V, V) const { return always(); }
};

// All points ±base + 2πk in an interval of at most two periods, and some outside
inline int periodic(V base, V lo, V hi, V offset, V *at) {
    const V middle = each<std::nearbyint>((lo + hi) / (4 * PI)) * (2 * PI);
    int count = 0;
    for (int sign : {-1, 1})
        for (int k = -2; k <= 2; k++) at[count++] = sign * base + middle + k * 2 * PI - offset;
    return count;
}

// The range on [lo, hi] of a function with slope at most 1 and values in [−1, 1], from its value in the middle
inline Range around(V value, V lo, V hi) {
    const V reach = (hi - lo) * 0.5 + 2 * EPSILON * larger(-lo, hi);
    return widened(larger(value - reach, splat(-1)), smaller(value + reach, splat(1)));
}

struct Sin {
    static constexpr bool SMOOTH = true;
    Jet jet(V v) const {
        const V s = each<std::sin>(v), c = each<std::cos>(v);
        return {{s, c, -s, -c, s}};
    }
    template <int ORDER>
    Range range(V lo, V hi) const { return around(jet((lo + hi) * 0.5).d[ORDER], lo, hi); }
    int stationary(V a, V lo, V hi, V *at) const {
        return periodic(each<std::acos>(clamped(a, splat(-1), splat(1))), lo, hi, splat(0), at);
    }
    M defined(V lo, V hi) const { return hi - lo < 4 * PI; }
};

struct Cos {
    static constexpr bool SMOOTH = true;
    Jet jet(V v) const {
        const V s = each<std::sin>(v), c = each<std::cos>(v);
        return {{c, -s, -c, s, c}};
    }
    template <int ORDER>
    Range range(V lo, V hi) const { return around(jet((lo + hi) * 0.5).d[ORDER], lo, hi); }
    int stationary(V a, V lo, V hi, V *at) const {
        return periodic(each<std::acos>(clamped(a, splat(-1), splat(1))), lo + PI / 2, hi + PI / 2, splat(PI / 2), at);
    }
    M defined(V lo, V hi) const { return hi - lo < 4 * PI; }
};

struct Tan {
    static constexpr bool SMOOTH = false;
    static V branch_center(V lo, V hi) { return each<std::nearbyint>((lo + hi) / (2 * PI)) * PI; }
    Jet jet(V v) const {
        const V t = each<std::tan>(v);
        return {{t, 1 + t * t}};
    }
    int stationary(V a, V lo, V hi, V *at) const {
        const V base = each<std::atan>(root(larger(a - 1, splat(0))));
        at[0] = branch_center(lo, hi) - base, at[1] = branch_center(lo, hi) + base;
        return 2;
    }
    M defined(V lo, V hi) const { return (lo - branch_center(lo, hi) > -1.57) & (hi - branch_center(lo, hi) < 1.57); }
};

struct Square {
    static constexpr bool SMOOTH = false;
    Jet jet(V v) const { return {{v * v, 2 * v}}; }
    int stationary(V a, V, V, V *at) const { return at[0] = a * 0.5, 1; }
    M defined(V, V) const { return always(); }
};

struct Absolute {
    static constexpr bool SMOOTH = false;
    Jet jet(V v) const { return {{absolute(v), v > 0 ? splat(1) : (v < 0 ? splat(-1) : splat(0))}}; }
    int stationary(V, V, V, V *at) const { return at[0] = splat(0), 1; }
    M defined(V, V) const { return always(); }
};

// v for v > 0, and slope · v for v ≤ 0
struct Leaky {
    static constexpr bool SMOOTH = false;
    double slope;
    Jet jet(V v) const { return {{v > 0 ? v : slope * v, v > 0 ? splat(1) : splat(slope)}}; }
    int stationary(V, V, V, V *at) const { return at[0] = splat(0), 1; }
    M defined(V, V) const { return always(); }
};

struct Clamp {
    static constexpr bool SMOOTH = false;
    double low, high;
    Jet jet(V v) const {
        const V y = clamped(v, splat(low), splat(high));
        return {{y, y == v ? splat(1) : splat(0)}};
    }
    int stationary(V, V, V, V *at) const { return at[0] = splat(low), at[1] = splat(high), 2; }
    M defined(V, V) const { return always(); }
};

// v up to 1, and 2√v − 1 beyond: the minimum of a quadratic cost in a ball, as a function of ‖b‖²
struct WithinBall {
    static constexpr bool SMOOTH = false;
    Jet jet(V v) const {
        const V r = root(larger(v, splat(1)));
        return {{v > 1 ? 2 * r - 1 : v, 1 / r}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = 1 / (a * a), 1; }
    M defined(V, V) const { return always(); }
};

// The derivative of WithinBall
struct SlopeWithinBall {
    static constexpr bool SMOOTH = false;
    Jet jet(V v) const {
        const V r = 1 / root(larger(v, splat(1)));
        return {{r, v > 1 ? -0.5 * r * r * r : splat(0)}};
    }
    int stationary(V a, V, V, V *at) const { return at[0] = splat(1), at[1] = 1 / each<std::cbrt>(4 * a * a), 2; }
    M defined(V, V) const { return always(); }
};

}  // namespace
