// Runs a flat program of operations on Taylor forms on one block of boxes after another, so that all forms of a block
// stay in the cache. program.py writes the programs.

#include "forms.h"

#include <cstdlib>
#include <memory>
#include <optional>

namespace {

constexpr int TILE = 4;  // rows and columns of a block of a matrix product; 4 × 4 vectors fit into the registers

// Σ_m w_m x_m + offset. The rounding error of one operation is bounded by ε times the magnitude of the result, that of
// several by ε times the magnitudes of the operands.
void combine(const Block &block, const int *&code) {
    const Entry out = block.entry(code);
    const int operations = *code++, count = *code++;
    const double offset = block.numbers[*code++];
    V operands = splat(std::fabs(offset)), radius = splat(0);
    fill(out, splat(0));
    for (int n = 0; n < count; n++) {
        const Entry x = block.entry(code);
        const int *const placing = block.placings[*code++];
        const double weight = block.numbers[*code++];
        if (x.support == out.support)
            for (int i = 0; i < x.support->count; i++) out.terms[i] += weight * x.terms[i];
        else
            for (int i = 0; i < x.support->count; i++) out.terms[placing[i]] += weight * x.terms[i];
        radius += std::fabs(weight) * x.radius();
        if (operations > 1) operands += std::fabs(weight) * block.magnitude(x);
    }
    out.terms[0] += offset;
    out.radius() = operations > 1 ? radius + 2 * operations * EPSILON * operands + TINY : radius;
    block.finish(out, operations == 1);
}

template <int J, int K>
void tile(const V *const *x, const double *w, int inner, int columns, V *const *out, int t) {
    V sum[J][K] = {};
    for (int i = 0; i < inner; i++)
        for (int j = 0; j < J; j++)
            for (int k = 0; k < K; k++) sum[j][k] += w[i * columns + j] * x[i][t + k];
    for (int j = 0; j < J; j++)
        for (int k = 0; k < K; k++) out[j][t + k] = sum[j][k];
}

template <int J>
void tiles(const V *const *x, const double *w, int inner, int columns, V *const *out, int terms) {
    int t = 0;
    for (; t + TILE <= terms; t += TILE) tile<J, TILE>(x, w, inner, columns, out, t);
    if (terms - t == 1) tile<J, 1>(x, w, inner, columns, out, t);
    if (terms - t == 2) tile<J, 2>(x, w, inner, columns, out, t);
    if (terms - t == 3) tile<J, 3>(x, w, inner, columns, out, t);
}

// taylor.matrix_product for one row; entries with a smaller support than the result are padded with zeros
void matrix_product(const Block &block, const int *&code) {
    const int inner = *code++, columns = *code++;
    const double *weights = block.numbers + *code++;
    const int count = *code++;  // number of terms of the result
    std::vector<const V *> x(inner);
    std::vector<V *> out(columns);
    V *radius = block.spare, *room = block.spare + inner;
    for (int i = 0; i < inner; i++) {
        const Entry entry = block.entry(code);
        const int *const placing = block.placings[*code++];
        radius[i] = entry.radius() + 4 * inner * EPSILON * block.magnitude(entry) + TINY;
        x[i] = entry.terms;
        if (entry.support->count < count) {
            for (int k = 0; k < count; k++) room[k] = splat(0);
            for (int k = 0; k < entry.support->count; k++) room[placing[k]] = entry.terms[k];
            x[i] = room, room += count;
        }
    }
    const int *results = code;
    for (int j = 0; j < columns; j++) out[j] = block.entry(code).terms;
    int j = 0;
    for (; j + TILE <= columns; j += TILE) tiles<TILE>(x.data(), weights + j, inner, columns, &out[j], count);
    for (; j < columns; j++) tiles<1>(x.data(), weights + j, inner, columns, &out[j], count);
    for (j = 0; j < columns; j++) {
        const Entry entry = block.entry(results);
        V total = splat(TINY);
        for (int i = 0; i < inner; i++) total += std::fabs(weights[i * columns + j]) * radius[i];
        entry.radius() = total;
        block.finish(entry, 0);
    }
}

enum Function {
    EXP, LOG, LOG1P, SQRT, RECIPROCAL, SIGMOID, SOFTPLUS, SIN, COS, TAN, SQUARE, ABSOLUTE, LEAKY, CLAMP, WITHIN_BALL,
    SLOPE_WITHIN_BALL
};

void apply_one(
    const Block &block, const Powers &powers, int function, const Entry &x, const Range &ends, const Entry &out,
    double p, double q
) {
    switch (function) {
        case EXP: return apply(block, powers, x, ends, out, Exp{});
        case LOG: return apply(block, powers, x, ends, out, Log{});
        case LOG1P: return apply(block, powers, x, ends, out, Log1p{});
        case SQRT: return apply(block, powers, x, ends, out, Sqrt{});
        case RECIPROCAL: return apply(block, powers, x, ends, out, Reciprocal{});
        case SIGMOID: return apply(block, powers, x, ends, out, Sigmoid{});
        case SOFTPLUS: return apply(block, powers, x, ends, out, Softplus{});
        case SIN: return apply(block, powers, x, ends, out, Sin{});
        case COS: return apply(block, powers, x, ends, out, Cos{});
        case TAN: return apply(block, powers, x, ends, out, Tan{});
        case SQUARE: return apply(block, powers, x, ends, out, Square{});
        case ABSOLUTE: return apply(block, powers, x, ends, out, Absolute{});
        case LEAKY: return apply(block, powers, x, ends, out, Leaky{p});
        case CLAMP: return apply(block, powers, x, ends, out, Clamp{p, q});
        case WITHIN_BALL: return apply(block, powers, x, ends, out, WithinBall{});
        case SLOPE_WITHIN_BALL: return apply(block, powers, x, ends, out, SlopeWithinBall{});
    }
}

// All functions of one form
void apply_functions(const Block &block, const int *&code) {
    const Entry x = block.entry(code);
    const Range ends = interval(block, x);
    const M known = finite(ends.low) & finite(ends.high);
    std::optional<Sigmoidal> shared;
    for (int count = *code++; count > 0; count--) {
        const int function = *code++;
        const Entry out = block.entry(code);
        const double p = block.numbers[code[0]], q = block.numbers[code[1]];
        const Powers powers = {block.products[code[2]], block.products[code[3]], block.placings[code[4]]};
        code += 5;
        if ((function == SIGMOID || function == SOFTPLUS) && block.degree > 1) {
            if (!shared) {
                Argument of = argument_of(x, known, ends);
                expand(block, powers, x, out, of);
                shared.emplace(Sigmoidal{of, Logistic(of.m), Logistic(of.lo), Logistic(of.hi)});
            }
            if (function == SIGMOID) apply(block, powers, *shared, out, Sigmoid{});
            else apply(block, powers, *shared, out, Softplus{});
        } else {
            apply_one(block, powers, function, x, ends, out, p, q);
            shared.reset();  // `apply_one` has overwritten the powers of the shared argument
        }
        if (function == SIGMOID || function == SOFTPLUS)
            out.radius() += ends.high > p ? splat(q) : splat(0);  // bound_rules._widened_above
    }
}

enum Operation {
    COMBINE, MATRIX_PRODUCT, MULTIPLY, FUNCTION, WHERE, WITHIN_LIMITS, SIGN, POSITIVE, NEGATION, CONJUNCTION, ROUNDED
};

// bound_rules._rounded: x (1 + θ) + η, rounded in an arithmetic with numbers up to `largest`
void rounded(const Block &block, const Entry &x, const Entry &out, double relative, double absolute, double largest) {
    const V size = block.magnitude(x) * (1 + 1e-9);
    const V radius = x.radius() + (relative * size + absolute) * (1 + 1e-9);
    for (int i = 0; i < x.support->count; i++) out.terms[i] = x.terms[i];
    out.radius() = size <= largest ? radius : splat(INFINITY);
    block.finish(out, 1);
}

V one(M truth) { return truth ? splat(1) : splat(0); }

void operate(const Block &block, int operation, const int *&code) {
    if (operation == COMBINE) return combine(block, code);
    if (operation == MATRIX_PRODUCT) return matrix_product(block, code);
    if (operation == FUNCTION) return apply_functions(block, code);
    const Entry x = block.entry(code), y = block.entry(code);
    if (operation == MULTIPLY) {
        const Entry out = block.entry(code);
        multiply(block, block.products[*code++], x, y, out);
        return block.finish(out, 0);
    }
    if (operation == WHERE) {
        const Entry truth = block.entry(code), out = block.entry(code);
        const int *const placings[] = {block.placings[code[0]], block.placings[code[1]]};
        code += 2;
        return where(block, truth_of(block, truth), placings, x, y, out);
    }
    if (operation == CONJUNCTION) {
        const Truth a = truth_of(block, x), b = truth_of(block, y);
        return between(block, block.entry(code), one(a.certain & b.certain), one(a.possible & b.possible));
    }
    if (operation == WITHIN_LIMITS) {  // from here on, y is the result
        const double low = block.numbers[*code++];
        return within_limits(block, x, y, low, block.numbers[*code++]);
    }
    if (operation == ROUNDED) {
        const double *const limits[] = {block.numbers + code[0], block.numbers + code[1], block.numbers + code[2]};
        code += 3;
        return rounded(block, x, y, *limits[0], *limits[1], *limits[2]);
    }
    const Range ends = interval(block, x);
    const V low = one(ends.low > 0), high = one(ends.high > 0);
    if (operation == SIGN) return between(block, y, low - one(ends.low < 0), high - one(ends.high < 0));
    if (operation == POSITIVE) return between(block, y, low, high);
    const Truth truth = truth_of(block, x);  // NEGATION
    between(block, y, one(~truth.possible), one(~truth.certain));
}

// taylor.box_form for the boxes of a block
void read_boxes(
    const Block &block, const int *&code, const double *lower, const double *upper, long first, long boxes
) {
    const int axes = *code++;
    for (int axis = 0; axis < axes; axis++) {
        const Entry y = block.entry(code);
        V low, high;
        for (int lane = 0; lane < LANES; lane++) {
            const long box = first + lane < boxes ? first + lane : boxes - 1;
            low[lane] = lower[box * axes + axis], high[lane] = upper[box * axes + axis];
        }
        fill(y, splat(0));
        y.terms[0] = (low + high) * 0.5;
        if (y.support->count > 1) y.terms[1] = (high - low) * 0.5;
        block.finish(y, 2);
    }
}

// Reads input forms (boxes, inputs, terms and r)
void read_forms(const Block &block, const int *&code, const double *given, long first, long boxes) {
    const int inputs = *code++, row = block.terms + 1;
    for (int input = 0; input < inputs; input++) {
        const Entry y = block.entry(code);
        for (int lane = 0; lane < LANES; lane++) {
            const long box = first + lane < boxes ? first + lane : boxes - 1;
            const double *const form = given + (box * inputs + input) * row;
            for (int i = 0; i < y.support->count; i++) y.terms[i][lane] = form[y.support->at[i]];
            y.radius()[lane] = form[block.terms];
        }
        block.finish(y, 0);
    }
}

// Writes the results (results, terms and r, boxes)
void write_results(const Block &block, const int *&code, double *results, long first, long boxes) {
    const long here = boxes - first < LANES ? boxes - first : LANES;
    const int count = *code++;
    for (int n = 0; n < count; n++, results += (block.terms + 1) * boxes) {
        const Entry y = block.entry(code);
        for (int i = 0; i <= y.support->count; i++) {
            const int row = i < y.support->count ? y.support->at[i] : block.terms;
            for (long lane = 0; lane < here; lane++) results[row * boxes + first + lane] = y.terms[i][lane];
        }
    }
}

// Reads dimension, degree, number of terms, axes of each monomial; then the supports, products and placings, each list
// after its length
void read_tables(Block &block, const int *tables) {
    block.dimension = *tables++, block.degree = *tables++, block.terms = *tables++;
    block.axes = tables, tables += 3 * block.terms;
    for (int count = *tables++; count > 0; count--) {
        const int *upto = tables;
        tables += 4;
        block.supports.push_back({upto[3], upto, tables});
        tables += upto[3];
    }
    for (std::vector<const int *> *list : {&block.products, &block.placings})
        for (int count = *tables++; count > 0; count--) {
            const int words = *tables++;
            list->push_back(tables);
            tables += words;
        }
}

}  // namespace

// Runs a program on boxes (lower, upper), (boxes, axes) each; if `upper` is null, on the forms in `lower`. `results`
// must be 0. Returns 1 if there is too little memory.
extern "C" int lyapnet_bound(
    const int *tables, const int *code, const double *numbers, const double *lower, const double *upper, long boxes,
    long arena, long spare, double *results
) {
    Block block;
    read_tables(block, tables);
    const size_t vectors = arena + spare;
    const std::unique_ptr<void, void (*)(void *)> memory(std::aligned_alloc(sizeof(V), vectors * sizeof(V)), std::free);
    if (!memory) return 1;
    block.arena = static_cast<V *>(memory.get()), block.spare = block.arena + arena, block.numbers = numbers;
    for (int count = *code++; count > 0; count--) {
        const Entry constant = block.entry(code);
        fill(constant, splat(0));
        constant.terms[0] = splat(numbers[*code++]);
        block.finish(constant, 0);
    }
    for (long first = 0; first < boxes; first += LANES) {
        const int *at = code;
        if (upper)
            read_boxes(block, at, lower, upper, first, boxes);
        else
            read_forms(block, at, lower, first, boxes);
        for (int count = *at++; count > 0; count--) {
            const int operation = *at++;
            operate(block, operation, at);
        }
        write_results(block, at, results, first, boxes);
    }
    return 0;
}

// eˣ (which = 0), eˣ − 1 (1) or log(1 + x) (2) of numbers, as bounds compute them; for tests
extern "C" void lyapnet_elementary(int which, double *values, long count) {
    for (long i = 0; i < count; i++) {
        const V x = splat(values[i]);
        values[i] = which == 2 ? log_one_more(x)[0] : which == 1 ? exponential(x).less_one[0] : exponential(x).whole[0];
    }
}
