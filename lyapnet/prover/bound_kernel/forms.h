// Taylor forms on a block of boxes, one box in each lane.
//
// The formulas and the bounds of rounding are those of lyapnet/prover/taylor.py, elementary_functions.py and
// branches.py; comments name the function that is implemented. A form stores only the terms of its support, the
// monomials that it can have. Sums have another order than torch's, and a product may be added without rounding (fused
// multiply-add); the bounds of rounding cover both.

#pragma once

#include "functions.h"

#include <vector>

namespace {

constexpr int MOST_AXES = 16;

struct Support {
    int count;         // number of monomials; the first is the constant 1
    const int *upto;   // numbers of monomials of degree ≤ 0, 1, 2 and 3
    const int *at;     // the numbers of the monomials, increasing
};

struct Entry {  // the form of one number: its terms, r, and Σ |terms| of degree 1, 2, 3
    V *terms;
    const Support *support;
    V &radius() const { return terms[support->count]; }
    V &size(int degree) const { return terms[support->count + degree]; }
};

struct Block {  // data that all operations on a block of boxes use
    int dimension, degree, terms;
    const int *axes;  // three for each monomial; −1 for none
    std::vector<Support> supports;
    std::vector<const int *> products;  // for each term of a product: number of summands, and (i, j) of x[i] · y[j]
    std::vector<const int *> placings;  // the position of each term of one support in another
    V *arena, *spare;                   // memory of the forms; memory for intermediate results of one operation
    const double *numbers;

    Entry entry(const int *&code) const {
        const int offset = *code++;
        return {arena + offset, &supports[*code++]};
    }
    V spread(const Entry &x) const {
        V total = x.size(1);
        for (int k = 2; k <= degree; k++) total += x.size(k);
        return total;
    }
    V magnitude(const Entry &x) const { return absolute(x.terms[0]) + spread(x) + x.radius(); }

    // Ends an operation: computes the sizes of its result, and adds the errors of this many rounded operations to r.
    void finish(const Entry &x, double operations) const {
        for (int k = 1, i = 1; k <= degree; k++) {
            V total = splat(0);
            for (; i < x.support->upto[k]; i++) total += absolute(x.terms[i]);
            x.size(k) = total;
        }
        if (operations > 0) x.radius() += 2 * operations * EPSILON * magnitude(x) + TINY;
    }
};

// TaylorForm.interval
Range interval(const Block &block, const Entry &x) {
    const Support &s = *x.support;
    const V spread = block.spread(x);
    V up = spread, down = spread;
    if (block.degree > 1 && s.upto[2] > s.upto[1]) {
        V slope[MOST_AXES], diagonal[MOST_AXES], across[MOST_AXES];
        for (int k = 0; k < block.dimension; k++) slope[k] = diagonal[k] = across[k] = splat(0);
        for (int i = 1; i < s.upto[1]; i++) slope[s.at[i] - 1] = absolute(x.terms[i]);
        for (int i = s.upto[1]; i < s.upto[2]; i++) {
            const int j = block.axes[3 * s.at[i]], k = block.axes[3 * s.at[i] + 1];
            if (j == k) {
                diagonal[k] = x.terms[i];
            } else {
                const V half = absolute(x.terms[i]) * 0.5;
                across[j] += half, across[k] += half;
            }
        }
        up = down = block.degree == 3 ? x.size(3) : splat(0);
        for (int k = 0; k < block.dimension; k++) {
            up += parabola(slope[k], across[k] + diagonal[k]);
            down += parabola(slope[k], across[k] - diagonal[k]);
        }
    }
    const V slack = x.radius() + 4 * block.terms * EPSILON * (absolute(x.terms[0]) + spread + x.radius()) + TINY;
    const V low = x.terms[0] - down - slack, high = x.terms[0] + up + slack;
    const M known = finite(low) & finite(high);
    return {known ? low : splat(-INFINITY), known ? high : splat(INFINITY)};
}

void fill(const Entry &out, V radius) {
    for (int i = 0; i < out.support->count; i++) out.terms[i] = splat(0);
    out.radius() = radius;
}

void between(const Block &block, const Entry &out, V low, V high) {
    fill(out, (high - low) * 0.5);
    out.terms[0] = (low + high) * 0.5;
    block.finish(out, 0);
}

// taylor.multiply, up to `finish`
void multiply(const Block &block, const int *product, const Entry &x, const Entry &y, const Entry &out) {
    const V ax = absolute(x.terms[0]) + block.spread(x), by = absolute(y.terms[0]) + block.spread(y);
    const V rx = x.radius(), ry = y.radius();
    const V rounding = (block.terms * block.terms + 8) * EPSILON * ((ax + rx) * (by + ry));
    V radius = ax * ry + by * rx + rx * ry + rounding + TINY;
    for (int k = 0; k < out.support->count; k++) {
        V sum = splat(0);
        for (int n = *product++; n > 0; n--, product += 2) sum += x.terms[product[0]] * y.terms[product[1]];
        out.terms[k] = sum;
    }
    for (int j = 1; block.degree > 1 && j <= block.degree; j++)
        for (int k = block.degree + 1 - j; k <= block.degree; k++) radius += x.size(j) * y.size(k);
    if (block.degree == 1) {  // _linear_product
        V *c = block.spare, *e = c + block.dimension;
        for (int k = 0; k < 2 * block.dimension; k++) c[k] = splat(0);
        for (int i = 1; i < x.support->count; i++) c[x.support->at[i] - 1] = x.terms[i];
        for (int i = 1; i < y.support->count; i++) e[y.support->at[i] - 1] = y.terms[i];
        for (int k = 0; k < block.dimension; k++) {
            out.terms[0] += c[k] * e[k] * 0.5;
            radius += absolute(c[k] * e[k]) * 0.5;
            for (int j = 0; j < k; j++) radius += absolute(c[j] * e[k] + c[k] * e[j]);
        }
    }
    out.radius() = radius;
}

// elementary_functions._secant, up to `finish`
template <class F>
void secant(const Entry &x, const Entry &out, V lo, V hi, const F &f) {
    const Jet low = f.jet(lo), high = f.jet(hi);
    const M wide = hi - lo > 1e-6 * larger(-lo, hi);
    const V a = wide ? (high.d[0] - low.d[0]) / (wide ? hi - lo : splat(1)) : f.jet((lo + hi) * 0.5).d[1];
    V points[MOST_STATIONARY];
    const int count = f.stationary(a, lo, hi, points);
    const V end = low.d[0] - a * lo, other = high.d[0] - a * hi;
    V least = smaller(end, other), most = larger(end, other), nearby = splat(0);
    V largest = larger(absolute(low.d[0]), absolute(high.d[0]));
    for (int k = 0; k < count; k++) {
        const V p = clamped(points[k] == points[k] ? points[k] : lo, lo, hi);
        const Jet at = f.jet(p);
        const V h = at.d[0] - a * p;
        least = smaller(least, h), most = larger(most, h);
        nearby = larger(nearby, (absolute(at.d[1] - a) + TINY) * 1e-12 * (1 + absolute(p)));
        largest = larger(largest, absolute(at.d[0]));
    }
    largest += 2 * absolute(a) * larger(-lo, hi);
    for (int i = 0; i < x.support->count; i++) out.terms[i] = a * x.terms[i];
    out.terms[0] += (least + most) * 0.5;
    out.radius() = absolute(a) * x.radius() + (most - least) * 0.5 + nearby + 16 * EPSILON * largest + TINY;
}

struct Powers {  // tables for y², y³ and y in the support of a smooth function of y
    const int *square, *cube, *placing;
};

struct Argument {  // the argument of a function: a form x = m + y with |y| ≤ w, and the powers of y
    Range ends;
    M known;
    V lo, hi, m, w;
    Entry y, yy, yyy;
};

Argument argument_of(const Entry &x, M known, const Range &ends) {
    const V lo = known ? ends.low : splat(1), hi = known ? ends.high : splat(1), m = (lo + hi) * 0.5;
    return {ends, known, lo, hi, m, (hi - lo) * 0.5 * (1 + 8 * EPSILON) + 4 * EPSILON * absolute(m), x, x, x};
}

// Computes y and its powers in `spare`.
void expand(const Block &block, const Powers &powers, const Entry &x, const Entry &out, Argument &of) {
    const int room = block.terms + 1 + block.degree;
    of.y = {block.spare, x.support};
    of.yy = {block.spare + room, out.support};
    of.yyy = {block.spare + 2 * room, out.support};
    for (int i = 0; i < x.support->count + 1 + block.degree; i++) of.y.terms[i] = x.terms[i];
    of.y.terms[0] -= of.m;
    of.y.radius() += 2 * EPSILON * block.magnitude(of.y) + TINY;
    multiply(block, powers.square, of.y, of.y, of.yy);
    if (block.degree == 2) return;
    block.finish(of.yy, 0);
    multiply(block, powers.cube, of.yy, of.y, of.yyy);
}

// elementary_functions._expanded, up to `finish`; `range` is that of the derivative of order DEGREE + 1
template <int DEGREE>
void expanded(const Powers &powers, const Argument &of, const Jet &jet, const Range &range, const Entry &out) {
    constexpr bool CUBIC = DEGREE == 3;
    const V w = of.w, M = (range.low + range.high) * 0.5, span = range.high - range.low;
    V a = jet.d[0], b = jet.d[1], c = jet.d[2] * 0.5, k = splat(0), e;
    if (CUBIC) {
        a -= M * w * w * w * w / 192, c += M * w * w / 24, k = jet.d[3] / 6;
        e = (absolute(M) / 192 + span / 48) * w * w * w * w * (1 + 1e-9);
    } else {
        b += M * w * w * 0.125;
        e = (absolute(M) / 24 + span / 12) * w * w * w * (1 + 1e-9);
    }
    const V higher = absolute(k) + FLOOR + absolute(M) * (CUBIC ? w : splat(1));
    e += 32 * EPSILON * (absolute(a) + (absolute(b) + FLOOR + (absolute(c) + FLOOR + higher * w) * w) * w) + TINY;
    for (int i = 0; i < out.support->count; i++) out.terms[i] = c * of.yy.terms[i];
    out.radius() = absolute(b) * of.y.radius() + absolute(c) * of.yy.radius() + e;
    if (CUBIC) {
        for (int i = 0; i < out.support->count; i++) out.terms[i] += k * of.yyy.terms[i];
        out.radius() += absolute(k) * of.yyy.radius();
    }
    for (int i = 0; i < of.y.support->count; i++) out.terms[powers.placing[i]] += b * of.y.terms[i];
    out.terms[0] += a;
}

// Ends the application of a function: r is infinite where the argument has no bound or f is not smooth on its interval.
void settle(const Block &block, const Entry &out, M known, double operations) {
    for (int i = 0; i < out.support->count; i++) out.terms[i] = known ? out.terms[i] : splat(0);
    block.finish(out, operations);
    out.radius() = known ? out.radius() : splat(INFINITY);
}

// elementary_functions.linearised
template <class F>
void apply(const Block &block, const Powers &powers, const Entry &x, const Range &ends, const Entry &out, const F &f) {
    const M known = finite(ends.low) & finite(ends.high) & f.defined(ends.low, ends.high);
    Argument of = argument_of(x, known, ends);
    if constexpr (F::SMOOTH) {
        if (block.degree > 1) {
            expand(block, powers, x, out, of);
            const Jet jet = f.jet(of.m);
            if (block.degree == 2) expanded<2>(powers, of, jet, f.template range<3>(of.lo, of.hi), out);
            else expanded<3>(powers, of, jet, f.template range<4>(of.lo, of.hi), out);
            return settle(block, out, known, 6);
        }
    }
    secant(x, out, of.lo, of.hi, f);
    settle(block, out, known, 2);
}

struct Sigmoidal {  // data that the sigmoid and the softplus of one form share
    Argument of;
    Logistic middle, low, high;
};

// The same for the sigmoid and the softplus in degrees 2 and 3
template <class F>
void apply(const Block &block, const Powers &powers, const Sigmoidal &shared, const Entry &out, const F &f) {
    const Argument &of = shared.of;
    const Logistic &low = shared.low, &high = shared.high;
    const Jet jet = f.jet(shared.middle);
    if (block.degree == 2) expanded<2>(powers, of, jet, f.template range<3>(of.lo, of.hi, low, high), out);
    else expanded<3>(powers, of, jet, f.template range<4>(of.lo, of.hi, low, high), out);
    settle(block, out, of.known, 6);
}

struct Truth {
    M certain, possible;
};

// branches._truth
Truth truth_of(const Block &block, const Entry &x) {
    const Range ends = interval(block, x);
    return {(ends.low > 0) | (ends.high < 0), ~(block.magnitude(x) == 0)};
}

// branches.where; the support of the result contains those of x and y
void where(
    const Block &block, const Truth &is, const int *const placings[2], const Entry &x, const Entry &y, const Entry &out
) {
    const int count = out.support->count;
    V *mine = block.spare, *other = mine + count, apart = splat(0);
    for (int i = 0; i < 2 * count; i++) mine[i] = splat(0);
    for (int i = 0; i < x.support->count; i++) mine[placings[0][i]] = x.terms[i];
    for (int i = 0; i < y.support->count; i++) other[placings[1][i]] = y.terms[i];
    for (int i = 0; i < count; i++) {
        apart += absolute(mine[i] - other[i]) * 0.5;
        out.terms[i] = (mine[i] + other[i]) * 0.5;
    }
    out.radius() = apart + larger(x.radius(), y.radius());
    block.finish(out, block.terms);
    for (int i = 0; i < count; i++) out.terms[i] = is.certain ? mine[i] : (is.possible ? out.terms[i] : other[i]);
    out.radius() = is.certain ? x.radius() : (is.possible ? out.radius() : y.radius());
    block.finish(out, 0);
}

// branches._within_limits
void within_limits(const Block &block, const Entry &y, const Entry &out, double low, double high) {
    const Range ends = interval(block, y);
    const M wide = ~(ends.high - ends.low <= high - low);
    const double room = 4 * EPSILON * (std::fabs(low) + std::fabs(high)) + TINY;
    for (int i = 0; i < y.support->count; i++) out.terms[i] = wide ? splat(0) : y.terms[i];
    out.terms[0] = wide ? splat((low + high) / 2) : out.terms[0];
    out.radius() = wide ? splat((high - low) / 2 + room) : y.radius();
    block.finish(out, 0);
}

}  // namespace
