// Taylor forms on a block of boxes, one box in each lane.
//
// The formulas, and what is covered of rounding, are those of lyapnet/graphs/taylor.py, elementary_functions.py and
// branches.py, to whose names the comments refer. A form holds the terms of its support alone: the monomials that it can
// have. Sums run in another order than torch's, and a product may be added without being rounded first (a fused
// multiply-add); the bounds of rounding cover both.

#pragma once

#include "functions.h"

#include <vector>

namespace {

constexpr int MOST_AXES = 16;

struct Support {
    int count;         // of monomials
    const int *upto;   // how many of them are of degree ≤ 0, 1, 2, 3
    const int *at;     // their numbers, rising
};

struct Entry {
    V *terms;  // of the support, and behind them the radius
    const Support *support;
    V &radius() const { return terms[support->count]; }
};

struct Block {  // what all operations on a block of boxes share
    int dimension, degree, terms;
    const int *axes;   // of each monomial, three
    const int *place;  // where the product of two monomials stands
    std::vector<Support> supports;
    V *arena, *dense, *spare;  // the forms; a form with all terms; room for an operation's own forms
    const double *numbers;

    Entry entry(const int *&code) const {
        const int offset = *code++;
        return {arena + offset, &supports[*code++]};
    }
};

struct Sizes {
    V of[4];  // Σ |terms| of each degree
    V spread;
};

Sizes sizes_of(const Block &block, const Entry &x) {
    Sizes sizes = {{splat(0), splat(0), splat(0), splat(0)}, splat(0)};
    const Support &s = *x.support;
    for (int k = 0, i = 0; k <= block.degree; k++) {
        for (; i < s.upto[k]; i++) sizes.of[k] += absolute(x.terms[i]);
        if (k) sizes.spread += sizes.of[k];
    }
    return sizes;
}

V magnitude(const Entry &x) {
    V total = absolute(x.radius());
    for (int i = 0; i < x.support->count; i++) total += absolute(x.terms[i]);
    return total;
}

// Room for so many rounded operations.
void round_off(const Entry &x, double operations) { x.radius() += 2 * operations * EPSILON * magnitude(x) + TINY; }

// TaylorForm.interval
Range interval(const Block &block, const Entry &x) {
    const Support &s = *x.support;
    const Sizes sizes = sizes_of(block, x);
    V up = sizes.spread, down = sizes.spread;
    if (s.upto[2] > s.upto[1]) {
        V slope[MOST_AXES], diagonal[MOST_AXES], across[MOST_AXES];
        for (int k = 0; k < block.dimension; k++) slope[k] = diagonal[k] = across[k] = splat(0);
        for (int i = s.upto[0]; i < s.upto[1]; i++) slope[s.at[i] - 1] = absolute(x.terms[i]);
        for (int i = s.upto[1]; i < s.upto[2]; i++) {
            const int j = block.axes[3 * s.at[i]], k = block.axes[3 * s.at[i] + 1];
            if (j == k) {
                diagonal[k] = x.terms[i];
            } else {
                const V half = absolute(x.terms[i]) * 0.5;
                across[j] += half, across[k] += half;
            }
        }
        up = down = sizes.of[3];
        for (int k = 0; k < block.dimension; k++) {
            up += parabola(slope[k], across[k] + diagonal[k]);
            down += parabola(slope[k], across[k] - diagonal[k]);
        }
    }
    const V slack = x.radius() + 4 * block.terms * EPSILON * (sizes.of[0] + sizes.spread + x.radius()) + TINY;
    const V low = x.terms[0] - down - slack, high = x.terms[0] + up + slack;
    const M known = finite(low) & finite(high);
    return {known ? low : splat(-INFINITY), known ? high : splat(INFINITY)};
}

void fill(const Entry &out, V radius) {
    for (int i = 0; i < out.support->count; i++) out.terms[i] = splat(0);
    out.radius() = radius;
}

void between(const Entry &out, V low, V high) {
    fill(out, (high - low) * 0.5);
    out.terms[0] = (low + high) * 0.5;
}

// Where terms of the support of `out` may be added up: in itself if that has them all.
V *opened(const Block &block, const Entry &out) {
    V *at = out.support->count == block.terms ? out.terms : block.dense;
    for (int i = 0; i < out.support->count; i++) at[out.support->at[i]] = splat(0);
    return at;
}

void closed(const Entry &out, const V *from) {
    if (from != out.terms)
        for (int i = 0; i < out.support->count; i++) out.terms[i] = from[out.support->at[i]];
}

// taylor.multiply, of forms with any support
void multiply(const Block &block, const Entry &x, const Entry &y, const Entry &out) {
    const Sizes a = sizes_of(block, x), b = sizes_of(block, y);
    const V ax = a.of[0] + a.spread, by = b.of[0] + b.spread, rx = x.radius(), ry = y.radius();
    V radius = ax * ry + by * rx + rx * ry + (block.terms * block.terms + 8) * EPSILON * (ax + rx) * (by + ry) + TINY;
    for (int j = 1; block.degree > 1 && j <= block.degree; j++)
        for (int k = block.degree + 1 - j; k <= block.degree; k++) radius += a.of[j] * b.of[k];
    V *into = opened(block, out);
    const Support &s = *x.support, &t = *y.support;
    for (int k = 0, i = 0; k <= block.degree; k++)
        for (; i < s.upto[k]; i++) {
            const V factor = x.terms[i];
            const int *place = block.place + s.at[i] * block.terms;
            for (int j = 0; j < t.upto[block.degree - k]; j++) into[place[t.at[j]]] += factor * y.terms[j];
        }
    if (block.degree == 1) {  // _linear_product
        V *c = block.spare, *e = c + block.dimension;
        for (int k = 0; k < 2 * block.dimension; k++) c[k] = splat(0);
        for (int i = 1; i < s.count; i++) c[s.at[i] - 1] = x.terms[i];
        for (int i = 1; i < t.count; i++) e[t.at[i] - 1] = y.terms[i];
        for (int k = 0; k < block.dimension; k++) {
            into[0] += c[k] * e[k] * 0.5;
            radius += absolute(c[k] * e[k]) * 0.5;
            for (int j = 0; j < k; j++) radius += absolute(c[j] * e[k] + c[k] * e[j]);
        }
    }
    closed(out, into);
    out.radius() = radius;
}

// elementary_functions._secant
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
        nearby = larger(nearby, absolute(at.d[1] - a) * 1e-12 * (1 + absolute(p)));
        largest = larger(largest, absolute(at.d[0]));
    }
    largest += 2 * absolute(a) * larger(-lo, hi);
    for (int i = 0; i < x.support->count; i++) out.terms[i] = a * x.terms[i];
    out.terms[0] += (least + most) * 0.5;
    out.radius() = absolute(a) * x.radius() + (most - least) * 0.5 + nearby + 16 * EPSILON * largest + TINY;
    round_off(out, 2);
}

// elementary_functions._expanded
template <class F, int DEGREE>
void expanded(const Block &block, const Entry &x, const Entry &out, V lo, V hi, const F &f) {
    constexpr bool CUBIC = DEGREE == 3;
    const V m = (lo + hi) * 0.5, w = (hi - lo) * 0.5 * (1 + 8 * EPSILON) + 4 * EPSILON * absolute(m);
    const Jet jet = f.jet(m);
    const Range range = f.template range<DEGREE + 1>(lo, hi);
    const V M = (range.low + range.high) * 0.5, span = range.high - range.low;
    V a = jet.d[0], b = jet.d[1], c = jet.d[2] * 0.5, k = splat(0), e;
    if (CUBIC) {
        a -= M * w * w * w * w / 192, c += M * w * w / 24, k = jet.d[3] / 6;
        e = (absolute(M) / 192 + span / 48) * (w * w * w * w) * (1 + 1e-9);
    } else {
        b += M * w * w * 0.125;
        e = (absolute(M) / 24 + span / 12) * (w * w * w) * (1 + 1e-9);
    }
    const V higher = absolute(c) + (absolute(k) + absolute(M) * (CUBIC ? w : splat(1))) * w;
    e += 32 * EPSILON * (absolute(a) + absolute(b) * w + higher * w * w) + TINY;
    Entry y = {block.spare, x.support}, yy = {y.terms + block.terms + 1, out.support};
    Entry yyy = {yy.terms + block.terms + 1, out.support};
    for (int i = 0; i <= x.support->count; i++) y.terms[i] = x.terms[i];
    y.terms[0] -= m;
    round_off(y, 1);
    multiply(block, y, y, yy);
    if (CUBIC) multiply(block, yy, y, yyy);
    V *into = opened(block, out);
    for (int i = 0; i < x.support->count; i++) into[x.support->at[i]] = b * y.terms[i];
    closed(out, into);
    for (int i = 0; i < out.support->count; i++) {
        out.terms[i] += c * yy.terms[i];
        if (CUBIC) out.terms[i] += k * yyy.terms[i];
    }
    out.terms[0] += a;
    out.radius() = absolute(b) * y.radius() + absolute(c) * yy.radius() + e;
    if (CUBIC) out.radius() += absolute(k) * yyy.radius();
    round_off(out, 6);
}

// elementary_functions.linearised, and bound_rules._loosened_above
template <class F>
void apply(const Block &block, const Entry &x, const Entry &out, const F &f) {
    const Range ends = interval(block, x);
    const M known = finite(ends.low) & finite(ends.high) & f.defined(ends.low, ends.high);
    const V lo = known ? ends.low : splat(1), hi = known ? ends.high : splat(1);
    if constexpr (F::SMOOTH) {
        if (block.degree == 2) expanded<F, 2>(block, x, out, lo, hi, f);
        else if (block.degree == 3) expanded<F, 3>(block, x, out, lo, hi, f);
        else secant(x, out, lo, hi, f);
    } else {
        secant(x, out, lo, hi, f);
    }
    for (int i = 0; i < out.support->count; i++) out.terms[i] = known ? out.terms[i] : splat(0);
    out.radius() = known ? out.radius() : splat(INFINITY);
    if constexpr (F::LOOSENED) out.radius() += ends.high > f.threshold ? splat(f.room) : splat(0);
}

struct Truth {
    M certain, possible;
};

// branches._truth
Truth truth_of(const Block &block, const Entry &x) {
    const Range ends = interval(block, x);
    return {(ends.low > 0) | (ends.high < 0), ~(magnitude(x) == 0)};
}

// branches.where
void where(const Block &block, const Entry &truth, const Entry &x, const Entry &y, const Entry &out) {
    const Truth is = truth_of(block, truth);
    V *into = opened(block, out), *other = block.spare, apart = splat(0);
    for (int i = 0; i < out.support->count; i++) other[out.support->at[i]] = splat(0);
    for (int i = 0; i < x.support->count; i++) into[x.support->at[i]] = x.terms[i];
    for (int i = 0; i < y.support->count; i++) other[y.support->at[i]] = y.terms[i];
    Entry both = {other + block.terms, out.support};
    for (int i = 0; i < out.support->count; i++) {
        const int k = out.support->at[i];
        apart += absolute(into[k] - other[k]) * 0.5;
        both.terms[i] = (into[k] + other[k]) * 0.5;
    }
    both.radius() = apart + larger(x.radius(), y.radius());
    round_off(both, block.terms);
    for (int i = 0; i < out.support->count; i++) {
        const int k = out.support->at[i];
        into[k] = is.certain ? into[k] : (is.possible ? both.terms[i] : other[k]);
    }
    closed(out, into);
    out.radius() = is.certain ? x.radius() : (is.possible ? both.radius() : y.radius());
}

// branches._no_wider
void no_wider(const Block &block, const Entry &y, const Entry &out, double low, double high) {
    const Range ends = interval(block, y);
    const M wide = ~(ends.high - ends.low <= high - low);
    const double room = 4 * EPSILON * (std::fabs(low) + std::fabs(high));
    for (int i = 0; i < y.support->count; i++) out.terms[i] = wide ? splat(0) : y.terms[i];
    out.terms[0] = wide ? splat((low + high) / 2) : out.terms[0];
    out.radius() = wide ? splat((high - low) / 2 + room) : y.radius();
}

}  // namespace
