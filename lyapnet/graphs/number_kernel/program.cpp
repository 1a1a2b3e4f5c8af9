// Runs flat programs on tensors of numbers. An instruction is a row of integers: its operation, its length, and for each
// operand a buffer, an offset and strides, in numbers. lyapnet/graphs/number_kernel/program.py writes them.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <utility>
#ifdef __AVX512F__
#include <immintrin.h>
#endif

namespace {

#ifdef __AVX512F__
constexpr int BYTES = 64;
#else
constexpr int BYTES = 32;
#endif

typedef int64_t Integer;

#define UNROLLED _Pragma("GCC unroll 16")  // a loop of a few steps whose results stay in registers

template <class T>
struct Of;
template <>
struct Of<double> {
    typedef double V __attribute__((vector_size(BYTES)));
    typedef int64_t M __attribute__((vector_size(BYTES)));
    static constexpr int LANES = BYTES / 8;
};
template <>
struct Of<float> {
    typedef float V __attribute__((vector_size(BYTES)));
    typedef int32_t M __attribute__((vector_size(BYTES)));
    static constexpr int LANES = BYTES / 4;
};

#define VECTOR typedef typename Of<T>::V V; [[maybe_unused]] constexpr int LANES = Of<T>::LANES

// --- Loading and storing the first `count` lanes of a vector ---

template <class T>
inline typename Of<T>::V load(const T *from) {
    typename Of<T>::V x;
    std::memcpy(&x, from, BYTES);
    return x;
}

template <class T>
inline void store(T *to, typename Of<T>::V x) { std::memcpy(to, &x, BYTES); }

template <class T>
inline typename Of<T>::V load_some(const T *from, int count) {
#ifdef __AVX512F__
    if constexpr (sizeof(T) == 8)
        return (typename Of<T>::V)_mm512_maskz_loadu_pd((1u << count) - 1, from);
    else
        return (typename Of<T>::V)_mm512_maskz_loadu_ps((1u << count) - 1, from);
#else
    typename Of<T>::V x = {};
    for (int i = 0; i < count; i++) x[i] = from[i];
    return x;
#endif
}

template <class T>
inline void store_some(T *to, typename Of<T>::V x, int count) {
#ifdef __AVX512F__
    if constexpr (sizeof(T) == 8)
        _mm512_mask_storeu_pd(to, (1u << count) - 1, (__m512d)x);
    else
        _mm512_mask_storeu_ps(to, (1u << count) - 1, (__m512)x);
#else
    for (int i = 0; i < count; i++) to[i] = x[i];
#endif
}

template <class T>
inline typename Of<T>::V gathered(const T *from, Integer stride, int count) {
    if (stride == 1) return count == Of<T>::LANES ? load(from) : load_some(from, count);
    typename Of<T>::V x = {};
    if (stride == 0) return *from - x;  // which keeps the sign of −0
    for (int i = 0; i < count; i++) x[i] = from[i * stride];
    return x;
}

template <class T>
inline void scattered(T *to, Integer stride, typename Of<T>::V x, int count) {
    if (stride == 1) {
        if (count == Of<T>::LANES)
            store(to, x);
        else
            store_some(to, x, count);
    } else
        for (int i = 0; i < count; i++) to[i * stride] = x[i];
}

template <class V>
inline auto total(V x) {
    auto sum = x[0];
    UNROLLED
    for (unsigned i = 1; i < sizeof(V) / sizeof(x[0]); i++) sum += x[i];
    return sum;
}

// --- Operations on the numbers of a vector; truths are 1 and 0 ---

template <class T, class F, class V, class... More>
V each(F f, V x, More... others) {
    V y;
    for (int i = 0; i < Of<T>::LANES; i++) y[i] = f(x[i], others[i]...);
    return y;
}

template <class T, class V>
inline V root(V x) { return each<T>([](double x) { return std::sqrt(x); }, x); }

template <class T>
T remainder_like(T x, T y) {  // with the sign of y, as torch has it
    const T r = std::fmod(x, y);
    return r != 0 && (r < 0) != (y < 0) ? r + y : r;
}

template <class T, class V>
inline V absolute(V x) { return x < 0 ? -x : x + V{}; }

// eʳ − 1 for |r| ≤ ½ log 2, by its series
inline Of<double>::V exponential_less_one(Of<double>::V r) {
    Of<double>::V tail = Of<double>::V{} + 1 / 6227020800.0;
    const double over[] = {479001600, 39916800, 3628800, 362880, 40320, 5040, 720, 120, 24, 6, 2};
    UNROLLED
    for (double factorial : over) tail = tail * r + 1 / factorial;
    return r + r * r * tail;
}

inline Of<float>::V exponential_less_one(Of<float>::V r) {
    Of<float>::V tail = Of<float>::V{} + 1 / 5040.0f;
    const float over[] = {720, 120, 24, 6, 2};
    UNROLLED
    for (float factorial : over) tail = tail * r + 1 / factorial;
    return r + r * r * tail;
}

// eˣ = 2ᵏ eʳ with |r| ≤ ½ log 2
inline Of<double>::V exponential(Of<double>::V x) {
    typedef Of<double>::V V;
    typedef Of<double>::M M;
    const double LOG2_HIGH = 6.93147180369123816490e-01, LOG2_LOW = 1.90821492927058770002e-10, SHIFT = 0x1.8p52;
    const V low = V{} - 708, high = V{} + 709;
    const V inside = x < low ? low : (x > high ? high : x);
    const V shifted = inside * 1.4426950408889634 + SHIFT, k = shifted - SHIFT;
    const V r = (inside - k * LOG2_HIGH) - k * LOG2_LOW;
    const V scale = (V)(((M)shifted + 1023) << 52);  // the low bits of `shifted` are k
    const V y = scale + scale * exponential_less_one(r);
    return x > high ? V{} + INFINITY : (x < low ? V{} : (x != x ? x : y));
}

inline Of<float>::V exponential(Of<float>::V x) {
    typedef Of<float>::V V;
    typedef Of<float>::M M;
    const float LOG2_HIGH = 6.93145752e-1f, LOG2_LOW = 1.42860677e-6f, SHIFT = 0x1.8p23f;
    const V low = V{} - 87, high = V{} + 88;
    const V inside = x < low ? low : (x > high ? high : x);
    const V shifted = inside * 1.44269504f + SHIFT, k = shifted - SHIFT;
    const V r = (inside - k * LOG2_HIGH) - k * LOG2_LOW;
    const V scale = (V)(((M)shifted + 127) << 23);
    const V y = scale + scale * exponential_less_one(r);
    return x > high ? V{} + INFINITY : (x < low ? V{} : (x != x ? x : y));
}

template <class T, class V>
inline V logistic(V x) {
    const V u = exponential(-absolute<T, V>(x)), large = 1 / (1 + u);
    return x < 0 ? u * large : (x != x ? x : large);
}

// tanh |x| = (1 − u)/(1 + u) with u = e^(−2|x|); for small |x|, where this cancels, e/(e + 2) with e = e^(2|x|) − 1
template <class T, class V>
inline V hyperbolic_tangent(V x) {
    const V size = absolute<T, V>(x), u = exponential(-2 * size), e = exponential_less_one(2 * size);
    const V t = (size > T(0.17) ? 1 - u : e) / (size > T(0.17) ? 1 + u : e + 2);
    return x < 0 ? -t : (x == 0 ? x : t);  // which keeps the sign of −0
}

inline double larger(double a, double b) { return a > b || a != a ? a : b; }
inline double smaller(double a, double b) { return a < b || a != a ? a : b; }
inline double remainder_of(double a, double b) { return remainder_like(a, b); }

// ELEMENTWISE is OPERANDS_n(NAME, expression of n vectors x, y, z) for every elementwise instruction, as program.py has
// them: here a type for each, and in INSTRUCTIONS the place of each.
#define ONE (V{} + 1)
#define ZERO (V{})
#define TYPE(NAME, DECLARED, ...)                    \
    template <class T>                               \
    struct Of_##NAME {                               \
        typedef typename Of<T>::V V;                 \
        static V of DECLARED { return __VA_ARGS__; } \
    };
#define OPERANDS_1(NAME, ...) TYPE(NAME, (V x), __VA_ARGS__)
#define OPERANDS_2(NAME, ...) TYPE(NAME, (V x, V y), __VA_ARGS__)
#define OPERANDS_3(NAME, ...) TYPE(NAME, (V x, V y, V z), __VA_ARGS__)
ELEMENTWISE
#undef OPERANDS_1
#undef OPERANDS_2
#undef OPERANDS_3
#define OPERANDS_1(NAME, ...) elementwise<T, Of_##NAME<T>, 1>,
#define OPERANDS_2(NAME, ...) elementwise<T, Of_##NAME<T>, 2>,
#define OPERANDS_3(NAME, ...) elementwise<T, Of_##NAME<T>, 3>,

// --- Instructions ---

constexpr int MOST_RANK = 8;

template <class T>
struct Operand {
    T *at;
    const Integer *strides;
};

template <class T>
struct Machine {
    T **buffers;
    const Integer *tables;  // positions, one after the other

    Operand<T> operand(const Integer *&row, int rank) const {
        Operand<T> found{buffers[row[0]] + row[1], row + 2};
        row += 2 + rank;
        return found;
    }
};

// Calls visit(pointers) for each row of a shape, the last axis being left to it
template <class T, int OPERANDS, class Visit>
inline void for_each_row(int rank, const Integer *shape, Operand<T> (&operands)[OPERANDS], Visit visit) {
    T *at[OPERANDS];
    UNROLLED
    for (int k = 0; k < OPERANDS; k++) at[k] = operands[k].at;
    Integer index[MOST_RANK] = {};
    while (true) {
        visit(at);
        int axis = rank - 2;
        for (; axis >= 0; axis--) {
            UNROLLED
            for (int k = 0; k < OPERANDS; k++) at[k] += operands[k].strides[axis];
            if (++index[axis] < shape[axis]) break;
            UNROLLED
            for (int k = 0; k < OPERANDS; k++) at[k] -= operands[k].strides[axis] * shape[axis];
            index[axis] = 0;
        }
        if (axis < 0) return;
    }
}

template <class T, class F, size_t... I>
inline typename Of<T>::V applied(T **at, const Integer *strides, Integer i, int count, std::index_sequence<I...>) {
    return F::of(gathered<T>(at[I + 1] + i * strides[I + 1], strides[I + 1], count)...);
}

template <class T, class F, size_t... I>
inline typename Of<T>::V applied_in_line(T **at, Integer i, std::index_sequence<I...>) {
    return F::of(load<T>(at[I + 1] + i)...);
}

// out = F(inputs), number by number
template <class T, class F, int INPUTS>
void elementwise(const Machine<T> &machine, const Integer *row) {
    VECTOR;
    const int rank = *row++;
    const Integer *shape = row;
    row += rank;
    Operand<T> operands[INPUTS + 1];
    Integer strides[INPUTS + 1];
    bool in_line = true;
    UNROLLED
    for (int k = 0; k <= INPUTS; k++) {
        operands[k] = machine.operand(row, rank);
        strides[k] = operands[k].strides[rank - 1];
        in_line = in_line && strides[k] == 1;
    }
    const Integer n = shape[rank - 1];
    constexpr auto inputs = std::make_index_sequence<INPUTS>();
    for_each_row<T, INPUTS + 1>(rank, shape, operands, [&](T **at) {
        Integer i = 0;
        if (in_line)
            for (; i + LANES <= n; i += LANES) store(at[0] + i, applied_in_line<T, F>(at, i, inputs));
        for (; i < n; i += LANES) {
            const int count = std::min<Integer>(LANES, n - i);
            scattered(at[0] + i * strides[0], strides[0], applied<T, F>(at, strides, i, count, inputs), count);
        }
    });
}

// out = F(out, input) over a shape in which strides of out are 0 along the axes that are reduced
template <class T, class F>
void reduction(const Machine<T> &machine, const Integer *row) {
    VECTOR;
    const int rank = *row++;
    const Integer *shape = row;
    row += rank;
    Operand<T> operands[2] = {machine.operand(row, rank), {}};
    operands[1] = machine.operand(row, rank);
    const Integer n = shape[rank - 1], to = operands[0].strides[rank - 1], from = operands[1].strides[rank - 1];
    for_each_row<T, 2>(rank, shape, operands, [&](T **at) {
        if (to == 0) {
            Integer i = 0;
            T y = *at[0];
            if (n >= LANES) {
                V many = gathered<T>(at[1], from, LANES);
                for (i = LANES; i + LANES <= n; i += LANES)
                    many = F::of(many, gathered<T>(at[1] + i * from, from, LANES));
                for (int lane = 0; lane < LANES; lane++) y = F::of(V{} + y, V{} + many[lane])[0];
            }
            for (; i < n; i++) y = F::of(V{} + y, V{} + at[1][i * from])[0];
            *at[0] = y;
        } else
            for (Integer i = 0; i < n; i += LANES) {
                const int count = std::min<Integer>(LANES, n - i);
                const V y = F::of(gathered<T>(at[0] + i * to, to, count), gathered<T>(at[1] + i * from, from, count));
                scattered(at[0] + i * to, to, y, count);
            }
    });
}

// out = the index of the largest or least number of an input along the last axis; of several the first; nan counts most
template <class T, bool LARGEST>
void extreme(const Machine<T> &machine, const Integer *row) {
    const int rank = *row++;
    const Integer *shape = row;
    row += rank;
    Operand<T> operands[2] = {machine.operand(row, rank), {}};
    operands[1] = machine.operand(row, rank);
    const Integer n = shape[rank - 1], stride = operands[1].strides[rank - 1];
    for_each_row<T, 2>(rank, shape, operands, [&](T **at) {
        Integer best = 0;
        T value = at[1][0];
        for (Integer i = 1; i < n && value == value; i++) {
            const T other = at[1][i * stride];
            if ((LARGEST ? other > value : other < value) || other != other) best = i, value = other;
        }
        *at[0] = best;
    });
}

// out = input[index], or out[index] = input, along an axis; the indexed operand has stride 0 along it
template <class T, bool INTO>
void indexed(const Machine<T> &machine, const Integer *row) {
    const Integer size = row[0], stride = row[1];
    const int rank = row[2];
    const Integer *shape = row + 3;
    row += 3 + rank;
    Operand<T> operands[3] = {machine.operand(row, rank), {}, {}};
    operands[1] = machine.operand(row, rank);
    operands[2] = machine.operand(row, rank);
    for_each_row<T, 3>(rank, shape, operands, [&](T **at) {
        for (Integer i = 0; i < shape[rank - 1]; i++) {
            const Integer index = at[2][i * operands[2].strides[rank - 1]];
            T *to = at[0] + i * operands[0].strides[rank - 1];
            const T *from = at[1] + i * operands[1].strides[rank - 1];
            const bool inside = index >= 0 && index < size;
            if (INTO && inside) to[index * stride] = *from;
            if (!INTO) *to = inside ? from[index * stride] : T(NAN);
        }
    });
}

// out[to] = input[from], or out[to] += input[from], with tables of the positions
template <class T, bool ADD>
void moved(const Machine<T> &machine, const Integer *row) {
    const Integer count = row[0], *to = machine.tables + row[1], *from = machine.tables + row[2];
    T *out = machine.buffers[row[3]] + row[4];
    const T *input = machine.buffers[row[5]] + row[6];
    for (Integer i = 0; i < count; i++) {
        if (ADD)
            out[to[i]] += input[from[i]];
        else
            out[to[i]] = input[from[i]];
    }
}

constexpr int COLUMNS = 2;  // vectors of a panel of packed columns

// Packs B (K, N) into panels, each with COLUMNS vectors of columns for all rows, padded with zeros
template <class T>
void packed(const Machine<T> &machine, const Integer *row) {
    const Integer K = row[0], N = row[1], k_stride = row[4], n_stride = row[5];
    const T *B = machine.buffers[row[2]] + row[3];
    T *out = machine.buffers[row[6]] + row[7];
    constexpr int WIDTH = COLUMNS * Of<T>::LANES;
    for (Integer first = 0; first < N; first += WIDTH) {
        const Integer width = std::min<Integer>(WIDTH, N - first);
        for (Integer k = 0; k < K; k++, out += WIDTH) {
            const T *from = B + k * k_stride + first * n_stride;
            for (Integer j = 0; j < width; j++) out[j] = from[j * n_stride];
            for (Integer j = width; j < WIDTH; j++) out[j] = 0;
        }
    }
}

template <class T, int ROWS>
inline void tile(Integer K, const T *A, Integer m_stride, Integer k_stride, const T *panel, T *out, Integer out_stride,
                 Integer width, bool add) {
    VECTOR;
    V sums[ROWS][COLUMNS] = {};
    for (Integer k = 0; k < K; k++) {
        V b[COLUMNS];
        UNROLLED
        for (int j = 0; j < COLUMNS; j++) b[j] = load(panel + (k * COLUMNS + j) * LANES);
        UNROLLED
        for (int i = 0; i < ROWS; i++) {
            const V a = V{} + A[i * m_stride + k * k_stride];
            UNROLLED
            for (int j = 0; j < COLUMNS; j++) sums[i][j] += a * b[j];
        }
    }
    UNROLLED
    for (int i = 0; i < ROWS; i++)
        UNROLLED
        for (int j = 0; j < COLUMNS; j++) {
            const int count = std::min<Integer>(LANES, width - j * LANES);
            if (count <= 0) break;
            T *to = out + i * out_stride + j * LANES;
            const V y = add ? sums[i][j] + load_some(to, count) : sums[i][j];
            store_some(to, y, count);
        }
}

// out (M, N) = A (M, K) B (K, N), or out += A B, for packed B; the rows of out are contiguous
template <class T>
void product_with_packed(const Machine<T> &machine, const Integer *row) {
    VECTOR;
    const Integer M = row[0], N = row[1], K = row[2];
    const bool add = row[3];
    T *out = machine.buffers[row[4]] + row[5];
    const Integer out_stride = row[6];
    const T *A = machine.buffers[row[7]] + row[8];
    const Integer m_stride = row[9], k_stride = row[10];
    const T *B = machine.buffers[row[11]] + row[12];
    constexpr int WIDTH = COLUMNS * LANES;
    for (Integer first = 0; first < N; first += WIDTH, B += K * WIDTH) {
        const Integer width = std::min<Integer>(WIDTH, N - first);
        Integer m = 0;
        for (; m + 8 <= M; m += 8)
            tile<T, 8>(K, A + m * m_stride, m_stride, k_stride, B, out + m * out_stride + first, out_stride, width, add);
        for (; m + 4 <= M; m += 4)
            tile<T, 4>(K, A + m * m_stride, m_stride, k_stride, B, out + m * out_stride + first, out_stride, width, add);
        for (; m < M; m++)
            tile<T, 1>(K, A + m * m_stride, m_stride, k_stride, B, out + m * out_stride + first, out_stride, width, add);
    }
}

// A (M, K) and B (K, N) of a batch of products, with their strides in memory
template <class T>
struct Factors {
    const T *A, *B;
    Integer m_stride, k_of_a, k_of_b, n_stride, M, N, K;
};

constexpr int MOST_COPIED = 2048;  // largest number of entries of a factor that is copied first

// For contiguous rows of A: sums of products along these and along columns of B, which are copied unless contiguous
template <class T>
void by_lines(const Factors<T> &f, T *out, Integer row_stride, Integer column_stride, bool add) {
    VECTOR;
    T copy[MOST_COPIED];
    const T *B = f.B;
    Integer n_stride = f.n_stride;
    if (f.k_of_b != 1) {
        for (Integer k = 0; k < f.K; k++)
            for (Integer n = 0; n < f.N; n++) copy[n * f.K + k] = B[k * f.k_of_b + n * n_stride];
        B = copy, n_stride = f.K;
    }
    for (Integer m = 0; m < f.M; m++)
        for (Integer n = 0; n < f.N; n++) {
            V sums = {};
            const T *a = f.A + m * f.m_stride, *b = B + n * n_stride;
            Integer k = 0;
            for (; k + LANES <= f.K; k += LANES) sums += load(a + k) * load(b + k);
            if (k < f.K) sums += load_some(a + k, f.K - k) * load_some(b + k, f.K - k);
            T &to = out[m * row_stride + n * column_stride];
            to = total(sums) + (add ? to : 0);
        }
}

// For columns of A that are contiguous: several rows at once, for N columns
template <class T, int N>
void by_rows(const Factors<T> &f, T *out, Integer row_stride, Integer column_stride, bool add) {
    VECTOR;
    for (Integer m = 0; m < f.M; m += LANES) {
        const int count = std::min<Integer>(LANES, f.M - m);
        V sums[N] = {};
        for (Integer k = 0; k < f.K; k++) {
            const V a = load_some(f.A + m + k * f.k_of_a, count);
            UNROLLED
            for (int n = 0; n < N; n++) sums[n] += a * f.B[k * f.k_of_b + n * f.n_stride];
        }
        UNROLLED
        for (int n = 0; n < N; n++)
            for (int i = 0; i < count; i++) {
                T &to = out[(m + i) * row_stride + n * column_stride];
                to = sums[n][i] + (add ? to : 0);
            }
    }
}

// For rows of B that are contiguous: several columns at once
template <class T>
void by_columns(const Factors<T> &f, T *out, Integer row_stride, bool add) {
    VECTOR;
    for (Integer m = 0; m < f.M; m++)
        for (Integer n = 0; n < f.N; n += LANES) {
            const int count = std::min<Integer>(LANES, f.N - n);
            T *to = out + m * row_stride + n;
            V sums = {};
            if (add) sums = load_some(to, count);
            for (Integer k = 0; k < f.K; k++)
                sums += (V{} + f.A[m * f.m_stride + k * f.k_of_a]) * load_some(f.B + k * f.k_of_b + n, count);
            store_some(to, sums, count);
        }
}

// Products of batches of small matrices, which are not packed
template <class T>
void products(const Machine<T> &machine, const Integer *row) {
    const Integer batch = row[0], M = row[1], N = row[2], K = row[3];
    const bool add = row[4];
    const Integer *o = row + 5, *a = row + 10, *b = row + 15;  // each: buffer, offset, strides of batch, rows, columns
    constexpr int LANES = Of<T>::LANES;
    for (Integer each = 0; each < batch; each++) {
        T *out = machine.buffers[o[0]] + o[1] + each * o[2];
        const Factors<T> f{machine.buffers[a[0]] + a[1] + each * a[2], machine.buffers[b[0]] + b[1] + each * b[2],
                           a[3], a[4], b[3], b[4], M, N, K};
        if (K >= LANES && f.k_of_a == 1 && (f.k_of_b == 1 || (M >= LANES && N * K <= MOST_COPIED)))
            by_lines(f, out, o[3], o[4], add);
        else if (f.m_stride == 1 && M >= LANES && N <= 4)
            (N == 1   ? by_rows<T, 1>
             : N == 2 ? by_rows<T, 2>
             : N == 3 ? by_rows<T, 3>
                      : by_rows<T, 4>)(f, out, o[3], o[4], add);
        else if (f.n_stride == 1 && o[4] == 1 && N > 1)
            by_columns(f, out, o[3], add);
        else
            for (Integer m = 0; m < M; m++)
                for (Integer n = 0; n < N; n++) {
                    T sum = 0;
                    for (Integer k = 0; k < K; k++) sum += f.A[m * a[3] + k * a[4]] * f.B[k * b[3] + n * b[4]];
                    T &to = out[m * o[3] + n * o[4]];
                    to = sum + (add ? to : 0);
                }
    }
}

// --- Small linear systems, one for each of a batch: the last two axes of the shape are a matrix ---

constexpr int MOST_UNKNOWNS = 32;  // as in program.py

// out = A⁻¹ of symmetric positive definite A, from its lower triangle, several matrices at once. Each pivot p in turn
// takes a_pp to −1/a_pp, a_ip to a_ip/a_pp and a_ij to a_ij − a_ip a_jp/a_pp: after the last one the matrix is −A⁻¹.
template <class T>
void symmetric_inverse(const Machine<T> &machine, const Integer *row) {
    VECTOR;
    const int rank = *row++, batch = rank - 3;
    const Integer *shape = row;
    const int d = shape[rank - 1];
    row += rank;
    Operand<T> operands[2] = {machine.operand(row, rank), {}};
    operands[1] = machine.operand(row, rank);
    const Integer *to = operands[0].strides + batch, *from = operands[1].strides + batch;  // of batch, rows, columns
    V a[MOST_UNKNOWNS][MOST_UNKNOWNS], column[MOST_UNKNOWNS];
    for_each_row<T, 2>(batch + 1, shape, operands, [&](T **at) {
        for (Integer first = 0; first < shape[batch]; first += LANES) {
            const int count = std::min<Integer>(LANES, shape[batch] - first);
            for (int i = 0; i < d; i++)
                for (int j = 0; j <= i; j++)
                    a[i][j] = gathered(at[1] + first * from[0] + i * from[1] + j * from[2], from[0], count);
            for (int p = 0; p < d; p++) {
                const V reciprocal = 1 / a[p][p];
                for (int i = 0; i < d; i++) column[i] = i < p ? a[p][i] : a[i][p];
                for (int i = 0; i < d; i++) {
                    const V scaled = column[i] * reciprocal;
                    for (int j = 0; j <= i; j++) {
                        if (i != p && j != p) a[i][j] -= scaled * column[j];
                    }
                    if (i != p) a[std::max(i, p)][std::min(i, p)] = scaled;
                }
                a[p][p] = -reciprocal;
            }
            for (int i = 0; i < d; i++)
                for (int j = 0; j < d; j++)
                    scattered(at[0] + first * to[0] + i * to[1] + j * to[2], to[0], -a[std::max(i, j)][std::min(i, j)],
                              count);
        }
    });
}

// Replaces v by the solution x of A x = v, from the lower triangle of symmetric positive definite A, which is overwritten
template <class T>
inline void solve_in_place(int d, T (&A)[MOST_UNKNOWNS][MOST_UNKNOWNS], T *v) {
    for (int j = 0; j < d; j++) {  // A = L Lᵀ
        for (int k = 0; k < j; k++)
            for (int i = j; i < d; i++) A[i][j] -= A[i][k] * A[j][k];
        const T root = std::sqrt(A[j][j]);
        for (int i = j; i < d; i++) A[i][j] /= root;
    }
    for (int i = 0; i < d; i++) {
        for (int k = 0; k < i; k++) v[i] -= A[i][k] * v[k];
        v[i] /= A[i][i];
    }
    for (int i = d - 1; i >= 0; i--) {
        for (int k = i + 1; k < d; k++) v[i] -= A[k][i] * v[k];
        v[i] /= A[i][i];
    }
}

constexpr int ROUNDS = 4;  // for each control, as in sets.py

// For each of m controls, whether it is at a limit where uᵀRu + bᵀu is least: −1 at the lower one, 1 at the upper one, 0
// at none. Each round moves u towards the minimum over the controls that are not fixed at a limit. The first limit on the
// way fixes its control; if there is none, the fixed control with the largest gain is released.
template <class T>
void find_active_set(int m, const T (&R)[MOST_UNKNOWNS][MOST_UNKNOWNS], const T *b, const T *low, const T *high, T *side) {
    T u[MOST_UNKNOWNS], A[MOST_UNKNOWNS][MOST_UNKNOWNS], step[MOST_UNKNOWNS];
    int free[MOST_UNKNOWNS];
    for (int i = 0; i < m; i++) {
        u[i] = std::min(std::max(-b[i] / (2 * R[i][i]), low[i]), high[i]);
        side[i] = (u[i] >= high[i]) - (u[i] <= low[i]);
    }
    for (int round = 0; round < ROUNDS * m; round++) {
        int count = 0;
        for (int i = 0; i < m; i++)
            if (side[i] == 0) free[count++] = i;
        for (int k = 0; k < count; k++) {
            const int i = free[k];
            step[k] = -b[i] / 2;
            for (int j = 0; j < m; j++) step[k] -= R[i][j] * u[j];
            for (int l = 0; l <= k; l++) A[k][l] = R[i][free[l]];
        }
        solve_in_place(count, A, step);
        T share = INFINITY;
        int first = -1;
        for (int k = 0; k < count; k++) {
            if (step[k] == 0) continue;
            const T room = ((step[k] > 0 ? high : low)[free[k]] - u[free[k]]) / step[k];
            if (room < share) share = room, first = k;
        }
        const bool arrived = !(share < 1);
        for (int k = 0; k < count; k++) u[free[k]] += (arrived ? 1 : share) * step[k];
        if (!arrived) {
            const int i = free[first];
            side[i] = step[first] > 0 ? 1 : -1;
            u[i] = (step[first] > 0 ? high : low)[i];
            continue;
        }
        T most = 0;
        int released = -1;
        for (int i = 0; i < m; i++) {
            if (side[i] == 0) continue;
            T slope = b[i];
            for (int j = 0; j < m; j++) slope += 2 * R[i][j] * u[j];
            const T gain = side[i] * slope / std::sqrt(R[i][i]);
            if (gain > most) most = gain, released = i;
        }
        if (released < 0) return;
        side[released] = 0;
    }
}

// side = the active set for (b, low, high, R) of a batch
template <class T>
void active_set(const Machine<T> &machine, const Integer *row) {
    const int rank = *row++, batch = rank - 3;
    const Integer *shape = row;
    const int m = shape[rank - 1];
    row += rank;
    Operand<T> operands[5] = {machine.operand(row, rank), {}, {}, {}, {}};
    for (int k = 1; k < 5; k++) operands[k] = machine.operand(row, rank);
    T R[MOST_UNKNOWNS][MOST_UNKNOWNS], vectors[4][MOST_UNKNOWNS];
    for_each_row<T, 5>(batch + 1, shape, operands, [&](T **at) {
        for (Integer each = 0; each < shape[batch]; each++) {
            const T *given[5];
            for (int k = 0; k < 5; k++) given[k] = at[k] + each * operands[k].strides[batch];
            for (int i = 0; i < m; i++) {
                for (int k = 1; k < 4; k++) vectors[k][i] = given[k][i * operands[k].strides[batch + 1]];
                for (int j = 0; j < m; j++)
                    R[i][j] = given[4][i * operands[4].strides[batch + 1] + j * operands[4].strides[batch + 2]];
            }
            find_active_set(m, R, vectors[1], vectors[2], vectors[3], vectors[0]);
            T *to = at[0] + each * operands[0].strides[batch];
            for (int i = 0; i < m; i++) to[i * operands[0].strides[batch + 1]] = vectors[0][i];
        }
    });
}

template <class T>
using Instruction = void (*)(const Machine<T> &, const Integer *);

// In the order of `operations_in_order` in program.py
template <class T>
const Instruction<T> INSTRUCTIONS[] = {
    reduction<T, Of_add<T>>,
    reduction<T, Of_maximum<T>>,
    reduction<T, Of_minimum<T>>,
    extreme<T, true>,
    extreme<T, false>,
    indexed<T, false>,
    indexed<T, true>,
    moved<T, false>,
    moved<T, true>,
    packed<T>,
    product_with_packed<T>,
    products<T>,
    symmetric_inverse<T>,
    active_set<T>,
    ELEMENTWISE
};

template <class T>
void run(const Integer *code, Integer words, const Integer *tables, T **buffers) {
    const Machine<T> machine{buffers, tables};
    for (const Integer *row = code; row < code + words; row += row[1]) INSTRUCTIONS<T>[row[0]](machine, row + 2);
}

// `first` once, then `every` for each step. After a step the buffers in `advances` (buffer, numbers) move on, and the
// next step reads in `input` what this one has written into `result`.
template <class T>
void scan(const Integer *first, Integer first_words, const Integer *every, Integer words, const Integer *tables,
          T **buffers, Integer steps, const Integer *advances, Integer moving, Integer input, Integer result, T *spare) {
    run<T>(first, first_words, tables, buffers);
    for (Integer step = 0; step < steps; step++) {
        run<T>(every, words, tables, buffers);
        for (Integer k = 0; k < moving; k++) buffers[advances[2 * k]] += advances[2 * k + 1];
        T *read = buffers[input];
        buffers[input] = buffers[result];
        buffers[result] = step == 0 ? spare : read;  // the first input is the caller's
    }
}

}  // namespace

// NUMBER is double or float: each is a file of its own, as most machines need one of them.
extern "C" void lyapnet_run(const Integer *code, Integer words, const Integer *tables, NUMBER **buffers) {
    run<NUMBER>(code, words, tables, buffers);
}

extern "C" int lyapnet_width() { return COLUMNS * Of<NUMBER>::LANES; }

extern "C" void lyapnet_scan(const Integer *first, Integer first_words, const Integer *every, Integer words,
                             const Integer *tables, NUMBER **buffers, Integer steps, const Integer *advances,
                             Integer moving, Integer input, Integer result, NUMBER *spare) {
    scan<NUMBER>(first, first_words, every, words, tables, buffers, steps, advances, moving, input, result, spare);
}
