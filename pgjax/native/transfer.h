// The two transfers, their tangents and their adjoint, on a CPU.
//
// All come from one multilinear form. In units of cells, with a payload (a, B, S) per particle and
// a value g per node,
//
//     Phi = sum_p sum_i g_i . [ w_ip (a_p + B_p (x_i - x_p)) + S_p grad w_ip ].
//
// The weights are products over the directions, so every sum is taken direction by direction:
// along each one a particle needs the three factors w, w r and w' at its K nodes.
//
// A node holds four values. Particles whose stencil does not fit in the array (or whose position
// is NaN) take no part: nothing is ever read or written outside of it.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>

#include "parallel.h"

namespace pgjax {

using Index = std::int64_t;
constexpr int kPad = 2;       // layers of nodes outside the grid's box
constexpr int kChannels = 4;  // values of a node
constexpr int kTile = 4;      // width of the columns of cells that one thread scatters at a time

template <class T>
struct VecOf {
  typedef T type __attribute__((vector_size(kChannels * sizeof(T))));
};
template <class T>
using Vec = typename VecOf<T>::type;

// Left to itself the compiler calls these, and passes what is in registers through memory.
#define PGJAX_INLINED __attribute__((always_inline))
#define PGJAX_INLINE inline PGJAX_INLINED

// Anywhere in an array of T, which it may alias.
template <class V, class T>
PGJAX_INLINE V load_as(const T* p) {
  typedef V Anywhere __attribute__((aligned(alignof(T))));
  return *reinterpret_cast<const Anywhere*>(p);
}
template <class T>
PGJAX_INLINE Vec<T> load(const T* p) {
  return load_as<Vec<T>>(p);
}

template <class V, class T>
PGJAX_INLINE void store(T* p, const V& v) {
  typedef V Anywhere __attribute__((aligned(alignof(T))));
  *reinterpret_cast<Anywhere*>(p) = v;
}

// The values of the K nodes of a stencil along the last direction, which lie side by side.
template <class T>
struct PairOf {
  typedef T type __attribute__((vector_size(2 * kChannels * sizeof(T))));
};
template <class T, int K>
struct Row {
  using Pair = typename PairOf<T>::type;
  using Rest = std::conditional_t<K == 4, Pair, Vec<T>>;
  Pair pair;
  Rest rest;

  PGJAX_INLINE Row& operator+=(const Row& o) { return pair += o.pair, rest += o.rest, *this; }
  PGJAX_INLINE friend Row operator+(Row a, const Row& b) { return a += b; }
  PGJAX_INLINE friend Row operator*(const Row& a, const Row& b) { return {a.pair * b.pair, a.rest * b.rest}; }
  PGJAX_INLINE friend Row operator*(T a, const Row& b) { return {a * b.pair, a * b.rest}; }
};

template <class P, class V>
PGJAX_INLINE P joined(V low, V high) {
  return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
}
template <class T, class P>
PGJAX_INLINE Vec<T> halves_added(P p) {
  const Vec<T> low = __builtin_shufflevector(p, p, 0, 1, 2, 3);
  const Vec<T> high = __builtin_shufflevector(p, p, 4, 5, 6, 7);
  return low + high;
}

// Each node's own number at all its channels.
template <class T, int K>
PGJAX_INLINE Row<T, K> each_its_own(const T w[K]) {
  using Pair = typename Row<T, K>::Pair;
  const Vec<T> zero = {}, w2 = zero + w[2];
  const Pair pair = joined<Pair, Vec<T>>(zero + w[0], zero + w[1]);
  if constexpr (K == 4)
    return {pair, joined<Pair, Vec<T>>(w2, zero + w[3])};
  else
    return {pair, w2};
}
template <class T, int K>
PGJAX_INLINE Vec<T> sum(const Row<T, K>& row) {
  if constexpr (K == 4)
    return halves_added<T>(row.pair + row.rest);
  else
    return halves_added<T>(row.pair) + row.rest;
}

template <class T, int K>
PGJAX_INLINE Row<T, K> load_row(const T* p) {
  using R = Row<T, K>;
  return {load_as<typename R::Pair>(p), load_as<typename R::Rest>(p + 2 * kChannels)};
}
template <class T, int K>
PGJAX_INLINE void add_to(T* p, Row<T, K> row) {
  row += load_row<T, K>(p);
  store(p, row.pair);
  store(p + 2 * kChannels, row.rest);
}

// A value and its derivative along one direction.
template <class N>
struct Dual {
  using Part = N;
  N v, d;

  PGJAX_INLINE Dual& operator+=(const Dual& o) { return v += o.v, d += o.d, *this; }
};
template <class W, class N>
PGJAX_INLINE N times(const W& w, const N& n) {
  return w * n;
}
template <class W, class N>
PGJAX_INLINE Dual<N> times(const Dual<W>& w, const Dual<N>& n) {
  return {w.v * n.v, w.v * n.d + w.d * n.v};
}

// The same value at every node of a row of type R; the sum over the nodes.
template <class R, class V>
PGJAX_INLINE R everywhere(const V& v) {
  const auto pair = joined<typename R::Pair>(v, v);
  if constexpr (std::is_same_v<typename R::Rest, V>)
    return {pair, v};
  else
    return {pair, pair};
}
template <class R, class V>
PGJAX_INLINE R everywhere(const Dual<V>& a) {
  return {everywhere<typename R::Part>(a.v), everywhere<typename R::Part>(a.d)};
}
template <class T, int K>
PGJAX_INLINE Dual<Vec<T>> sum(const Dual<Row<T, K>>& a) {
  return {sum(a.v), sum(a.d)};
}

// Factors along one direction at the K nodes of a stencil; r = x_i - x_p.
template <class W, int K>
struct Axis {
  W w[K], wr[K], dw[K];
};

// First node of the stencil, in cells.
template <class T, int K>
PGJAX_INLINE T first_node(T xi) {
  return std::floor(xi - T(K - 2) / 2);
}

// Weights of the B-spline of degree K - 1, and their first and second derivatives. Written so that
// sum w = 1 and sum w' = 0 hold up to one rounding.
template <class T, int K>
PGJAX_INLINE void spline(T offset, T w[K], T dw[K], T ddw[K]) {
  if constexpr (K == 3) {
    const T t = offset - T(0.5), s = 1 - t;
    w[0] = s * s / 2, w[2] = t * t / 2, w[1] = 1 - (w[0] + w[2]);
    dw[0] = -s, dw[1] = s - t, dw[2] = t;
    ddw[0] = 1, ddw[1] = -2, ddw[2] = 1;
  } else {
    // s^3/6 and t^3/6 cancel in the sums.
    const T t = offset - 1, s = 1 - t;
    const T a = s * s * s / 6, b = t * t * t / 6, da = -s * s / 2, db = t * t / 2;
    w[0] = a, w[1] = s - (2 * a - b), w[2] = t - (2 * b - a), w[3] = b;
    dw[0] = da, dw[1] = -1 - (2 * da - db), dw[2] = 1 - (2 * db - da), dw[3] = db;
    ddw[0] = s, ddw[1] = t - 2 * s, ddw[2] = s - 2 * t, ddw[3] = t;
  }
}

template <class T, int K>
PGJAX_INLINE void factors(T offset, Axis<T, K>& value) {
  T ddw[K];
  spline<T, K>(offset, value.w, value.dw, ddw);
  for (int i = 0; i < K; ++i) value.wr[i] = value.w[i] * (i - offset);
}

// The factors and their derivatives with respect to the position (in cells).
template <class T, int K>
PGJAX_INLINE void factors(T offset, Axis<T, K>& value, Axis<T, K>& slope) {
  spline<T, K>(offset, value.w, value.dw, slope.dw);
  for (int i = 0; i < K; ++i) {
    const T r = i - offset;
    value.wr[i] = value.w[i] * r;
    slope.w[i] = value.dw[i];
    slope.wr[i] = value.dw[i] * r - value.w[i];
  }
}

// The factors of the last direction, as rows.
template <class R>
struct LastAxis {
  R w, wr, dw;
};
template <class T, int K>
PGJAX_INLINE LastAxis<Row<T, K>> last_axis(const Axis<T, K>& axis) {
  return {each_its_own<T, K>(axis.w), each_its_own<T, K>(axis.wr), each_its_own<T, K>(axis.dw)};
}
template <class T, int K>
PGJAX_INLINE Dual<Row<T, K>> each_its_own(const Dual<T> a[K]) {
  T v[K], d[K];
  for (int i = 0; i < K; ++i) v[i] = a[i].v, d[i] = a[i].d;
  return {each_its_own<T, K>(v), each_its_own<T, K>(d)};
}
template <class T, int K>
PGJAX_INLINE LastAxis<Dual<Row<T, K>>> last_axis(const Axis<Dual<T>, K>& axis) {
  return {each_its_own<T, K>(axis.w), each_its_own<T, K>(axis.wr), each_its_own<T, K>(axis.dw)};
}

// What is left of a payload after some directions: M of them are still to come.
template <class N, int M, bool HasS>
struct Coefficients {
  N A;
  std::array<N, M> B;
  std::array<N, HasS ? M : 0> S;
};

template <class W, int K, class N, int M, bool HasS>
PGJAX_INLINE Coefficients<N, M - 1, HasS> descend(const Axis<W, K>& axis, int i,
                                            const Coefficients<N, M, HasS>& c) {
  Coefficients<N, M - 1, HasS> n;
  n.A = times(axis.w[i], c.A);
  n.A += times(axis.wr[i], c.B[0]);
  if constexpr (HasS) n.A += times(axis.dw[i], c.S[0]);
  for (int m = 1; m < M; ++m) {
    n.B[m - 1] = times(axis.w[i], c.B[m]);
    if constexpr (HasS) n.S[m - 1] = times(axis.w[i], c.S[m]);
  }
  return n;
}

// The transpose of `descend`.
template <class W, int K, class N, int M, bool HasS>
PGJAX_INLINE void ascend(const Axis<W, K>& axis, int i, const Coefficients<N, M - 1, HasS>& n,
                   Coefficients<N, M, HasS>& c) {
  c.A += times(axis.w[i], n.A);
  c.B[0] += times(axis.wr[i], n.A);
  if constexpr (HasS) c.S[0] += times(axis.dw[i], n.A);
  for (int m = 1; m < M; ++m) {
    c.B[m] += times(axis.w[i], n.B[m - 1]);
    if constexpr (HasS) c.S[m] += times(axis.w[i], n.S[m - 1]);
  }
}

// `descend` along the last direction, all its nodes at once, before any other direction.
template <class R, class V, int M, bool HasS>
PGJAX_INLINE Coefficients<R, M - 1, HasS> widen(const LastAxis<R>& axis,
                                          const Coefficients<V, M, HasS>& c) {
  Coefficients<R, M - 1, HasS> n;
  n.A = times(axis.w, everywhere<R>(c.A));
  n.A += times(axis.wr, everywhere<R>(c.B[M - 1]));
  if constexpr (HasS) n.A += times(axis.dw, everywhere<R>(c.S[M - 1]));
  for (int m = 0; m < M - 1; ++m) {
    n.B[m] = times(axis.w, everywhere<R>(c.B[m]));
    if constexpr (HasS) n.S[m] = times(axis.w, everywhere<R>(c.S[m]));
  }
  return n;
}

// The transpose of `widen`.
template <class V, class R, int N, bool HasS>
PGJAX_INLINE Coefficients<V, N + 1, HasS> narrow(const LastAxis<R>& axis,
                                           const Coefficients<R, N, HasS>& n) {
  Coefficients<V, N + 1, HasS> c;
  c.A = sum(times(axis.w, n.A));
  c.B[N] = sum(times(axis.wr, n.A));
  if constexpr (HasS) c.S[N] = sum(times(axis.dw, n.A));
  for (int m = 0; m < N; ++m) {
    c.B[m] = sum(times(axis.w, n.B[m]));
    if constexpr (HasS) c.S[m] = sum(times(axis.w, n.S[m]));
  }
  return c;
}

// Scatter of one particle, widened: `node` is the first node that is left of its stencil.
template <class T, class W, int K, class N, int M, bool HasS>
PGJAX_INLINE void spread(const Axis<W, K>* axes, const Coefficients<N, M, HasS>& c, T* node,
                   const Index* stride) {
#pragma GCC unroll 4
  for (int i = 0; i < K; ++i, node += *stride) {
    const auto n = descend(*axes, i, c);
    if constexpr (M > 1) {
      spread(axes + 1, n, node, stride + 1);
    } else if constexpr (std::is_same_v<N, Row<T, K>>) {
      add_to(node, n.A);
    } else {
      add_to(node, n.A.d);
    }
  }
}

template <class T, int K>
PGJAX_INLINE void read(const T* g, Index at, Row<T, K>& out) {
  out = load_row<T, K>(g + at);
}
template <class T, int K>
PGJAX_INLINE void read(Dual<const T*> g, Index at, Dual<Row<T, K>>& out) {
  out = {load_row<T, K>(g.v + at), load_row<T, K>(g.d + at)};
}

// Gather of one particle, not yet narrowed.
template <class T, class W, int K, class N, int M, bool HasS, class G>
PGJAX_INLINE Coefficients<N, M, HasS> collect(const Axis<W, K>* axes, G g, Index at,
                                        const Index* stride) {
  Coefficients<N, M, HasS> c{};
#pragma GCC unroll 4
  for (int i = 0; i < K; ++i, at += *stride) {
    Coefficients<N, M - 1, HasS> n;
    if constexpr (M > 1) {
      n = collect<T, W, K, N, M - 1, HasS>(axes + 1, g, at, stride + 1);
    } else {
      read(g, at, n.A);
    }
    ascend(*axes, i, n, c);
  }
  return c;
}

// The product of two sets of coefficients.
template <class N, int M, bool HasS>
PGJAX_INLINE N product(const Coefficients<N, M, HasS>& a, const Coefficients<N, M, HasS>& b) {
  N sum = a.A * b.A;
  for (int m = 0; m < M; ++m) {
    sum += a.B[m] * b.B[m];
    if constexpr (HasS) sum += a.S[m] * b.S[m];
  }
  return sum;
}

// The derivative of Phi with respect to position (into `pull`, to be summed over its lanes) and
// payload (returned), at payload c and node values g; both widened.
template <class T, int K, int M, bool HasS>
PGJAX_INLINE Coefficients<Row<T, K>, M, HasS> differentiate(const Axis<T, K>* axes,
                                                      const Axis<T, K>* slopes,
                                                      const Coefficients<Row<T, K>, M, HasS>& c,
                                                      const T* g, Index at, const Index* stride,
                                                      Row<T, K>* pull) {
  Coefficients<Row<T, K>, M, HasS> bar{};
#pragma GCC unroll 4
  for (int i = 0; i < K; ++i, at += *stride) {
    Coefficients<Row<T, K>, M - 1, HasS> n;
    if constexpr (M > 1) {
      n = differentiate(axes + 1, slopes + 1, descend(*axes, i, c), g, at, stride + 1, pull + 1);
    } else {
      n.A = load_row<T, K>(g + at);
    }
    *pull += product(descend(*slopes, i, c), n);
    ascend(*axes, i, n, bar);
  }
  return bar;
}

// An array with a leading batch direction of length 1 or that of the call.
template <class T>
struct Batched {
  T* data = nullptr;
  Index step = 0;  // 0: shared by the whole batch
  T* at(Index b) const { return data + b * step; }
};

// What does not depend on the particle.
template <int D>
struct Shape {
  Index particles, nodes[D];

  Index node_count() const {
    Index n = 1;
    for (Index k : nodes) n *= k;
    return n;
  }
  std::array<Index, D> strides() const {
    std::array<Index, D> s;
    Index step = kChannels;
    for (int i = D - 1; i >= 0; --i) s[i] = step, step *= nodes[i];
    return s;
  }
};

// Where the stencil of a particle lies in the array; false where it does not fit.
template <class T, int D, int K>
PGJAX_INLINE bool locate(const Shape<D>& shape, const T* xi, Index first[D], T offset[D]) {
  for (int i = 0; i < D; ++i) {
    const T base = first_node<T, K>(xi[i]);
    // Written so that NaN is refused.
    if (!(base >= -kPad && base <= T(shape.nodes[i] - kPad - K))) return false;
    first[i] = Index(base) + kPad;
    offset[i] = xi[i] - base;
  }
  return true;
}

template <int D>
PGJAX_INLINE Index offset_of(const std::array<Index, D>& strides, const Index first[D]) {
  Index at = 0;
  for (int i = 0; i < D; ++i) at += first[i] * strides[i];
  return at;
}

template <class V>
PGJAX_INLINE auto total(V v) {
  return v[0] + v[1] + v[2] + v[3];
}

template <class T>
struct Payload {
  Batched<const T> a, B, S;
};
template <class T>
struct Moments {
  Batched<T> a, B, S;
};

template <class T, int D, bool HasS>
PGJAX_INLINE Coefficients<Vec<T>, D, HasS> load_payload(const Payload<T>& from, Index b, Index p) {
  Coefficients<Vec<T>, D, HasS> c;
  c.A = load(from.a.at(b) + p * kChannels);
  for (int j = 0; j < D; ++j) {
    const Index at = (p * D + j) * kChannels;
    c.B[j] = load(from.B.at(b) + at);
    if constexpr (HasS) c.S[j] = load(from.S.at(b) + at);
  }
  return c;
}

template <class T, int D, bool HasS>
PGJAX_INLINE void store_moments(const Moments<T>& to, Index b, Index p,
                                const Coefficients<Vec<T>, D, HasS>& c) {
  store(to.a.at(b) + p * kChannels, c.A);
  for (int j = 0; j < D; ++j) {
    const Index at = (p * D + j) * kChannels;
    store(to.B.at(b) + at, c.B[j]);
    if constexpr (HasS) store(to.S.at(b) + at, c.S[j]);
  }
}

template <class V, int D, bool HasS>
PGJAX_INLINE Coefficients<Dual<V>, D, HasS> paired(const Coefficients<V, D, HasS>& v,
                                             const Coefficients<V, D, HasS>& d) {
  Coefficients<Dual<V>, D, HasS> c;
  c.A = {v.A, d.A};
  for (int j = 0; j < D; ++j) {
    c.B[j] = {v.B[j], d.B[j]};
    if constexpr (HasS) c.S[j] = {v.S[j], d.S[j]};
  }
  return c;
}

template <class V, int D, bool HasS>
PGJAX_INLINE Coefficients<V, D, HasS> tangent_of(const Coefficients<Dual<V>, D, HasS>& c) {
  Coefficients<V, D, HasS> d;
  d.A = c.A.d;
  for (int j = 0; j < D; ++j) {
    d.B[j] = c.B[j].d;
    if constexpr (HasS) d.S[j] = c.S[j].d;
  }
  return d;
}

template <class T, int K>
PGJAX_INLINE Axis<Dual<T>, K> moving_factors(T offset, T speed) {
  Axis<T, K> value, slope;
  factors<T, K>(offset, value, slope);
  Axis<Dual<T>, K> out;
  for (int i = 0; i < K; ++i) {
    out.w[i] = {value.w[i], slope.w[i] * speed};
    out.wr[i] = {value.wr[i], slope.wr[i] * speed};
    out.dw[i] = {value.dw[i], slope.dw[i] * speed};
  }
  return out;
}

// Particles sorted by the column of cells their stencil starts in; the order inside a column is
// that of the arrays. Columns of one of four colours share no node.
template <class T, int D, int K>
class Columns {
 public:
  Columns(const Shape<D>& shape, const T* xi) {
    across_ = (shape.nodes[1] + kTile - 1) / kTile;
    const Index count = (shape.nodes[0] + kTile - 1) / kTile * across_;
    start_.assign(count + 2, 0);
    column_.resize(shape.particles);
    for (Index p = 0; p < shape.particles; ++p) {
      Index first[D] = {};
      T offset[D] = {};
      const bool fits = locate<T, D, K>(shape, xi + p * D, first, offset);
      column_[p] = fits ? std::int32_t(first[0] / kTile * across_ + first[1] / kTile) : -1;
      if (fits) ++start_[column_[p] + 2];
    }
    for (Index k = 2; k < count + 2; ++k) start_[k] += start_[k - 1];
    order_.resize(start_[count + 1]);
    for (Index p = 0; p < shape.particles; ++p)
      if (column_[p] >= 0) order_[start_[column_[p] + 1]++] = std::int32_t(p);
    for (Index k = 0; k < count; ++k)
      if (start_[k + 1] > start_[k]) colours_[(k / across_ & 1) * 2 + (k % across_ & 1)].push_back(k);
  }
  // Calls `scatter(p)` for every particle; the sums do not depend on the number of threads.
  template <class F>
  void for_each(Pool& pool, const F& scatter) const {
    for_each_group(pool, 1, [&](const std::int32_t* p, int) { scatter(*p); });
  }
  // The same, with up to `size` particles of a column at a time: `scatter(first, count)`.
  template <class F>
  void for_each_group(Pool& pool, int size, const F& scatter) const {
    for_each_numbered_group(pool, size,
                            [&](const std::int32_t* first, int count, Index) { scatter(first, count); });
  }
  // And with a number of the group, below `groups(size)`.
  template <class F>
  void for_each_numbered_group(Pool& pool, int size, const F& scatter) const {
    for (const auto& colour : colours_) {
      pool.run(Index(colour.size()), [&](Index i) {
        const Index k = colour[i];
        for (Index j = start_[k]; j < start_[k + 1]; j += size)
          scatter(order_.data() + j, int(std::min<Index>(size, start_[k + 1] - j)),
                  k + start_[k] / size + (j - start_[k]) / size);
      });
    }
  }
  Index groups(int size) const { return Index(start_.size()) + Index(order_.size()) / size + 1; }

 private:
  Index across_;
  std::vector<Index> start_;
  std::vector<std::int32_t> column_, order_;
  std::array<std::vector<Index>, 4> colours_;
};

// Calls `one(b, pool)` for each member of a batch: members side by side if there are enough of
// them, else one after the other with all threads.
template <class F>
inline void for_each_member(Index batch, Pool& pool, const F& one) {
  if (batch >= pool.threads()) {
    pool.run(batch, [&](Index b) {
      Pool alone;
      one(b, alone);
    });
  } else {
    for (Index b = 0; b < batch; ++b) one(b, pool);
  }
}

// Calls `one(p)` for each particle, in chunks.
template <class F>
inline void for_each_particle(Index particles, Pool& pool, const F& one) {
  constexpr Index kChunk = 1024;
  pool.run((particles + kChunk - 1) / kChunk, [&](Index chunk) {
    const Index end = std::min(particles, (chunk + 1) * kChunk);
    for (Index p = chunk * kChunk; p < end; ++p) one(p);
  });
}

inline void clear(void* data, Index bytes, Pool& pool) {
  constexpr Index kChunk = 1 << 18;
  pool.run((bytes + kChunk - 1) / kChunk, [&](Index i) {
    std::memset(static_cast<char*>(data) + i * kChunk, 0, std::min(kChunk, bytes - i * kChunk));
  });
}

// The nodes from `first` to before `end` along each direction.
template <int D>
struct Box {
  Index first[D], end[D];

  Index rows() const {
    Index n = 1;
    for (int i = 0; i < D - 1; ++i) n *= end[i] - first[i];
    return n;
  }
  // Where row r of the box is in the whole grid, counted in rows; its place along the directions.
  Index row(const Index nodes[D], Index r, Index place[D]) const {
    for (int i = D - 2; i >= 0; --i) {
      const Index width = end[i] - first[i];
      place[i] = first[i] + r % width, r /= width;
    }
    Index at = 0;
    for (int i = 0; i < D - 1; ++i) at = at * nodes[i] + place[i];
    return at;
  }
};

// All nodes that the stencils of the particles touch; none where there are no particles.
template <class T, int D, int K>
Box<D> touched(const Shape<D>& shape, const T* xi) {
  Box<D> box;
  for (int i = 0; i < D; ++i) box.first[i] = shape.nodes[i], box.end[i] = 0;
  for (Index p = 0; p < shape.particles; ++p) {
    Index first[D] = {};
    T offset[D] = {};
    if (!locate<T, D, K>(shape, xi + p * D, first, offset)) continue;
    for (int i = 0; i < D; ++i) {
      box.first[i] = std::min(box.first[i], first[i]);
      box.end[i] = std::max(box.end[i], first[i] + K);
    }
  }
  for (int i = 0; i < D; ++i) box.first[i] = std::min(box.first[i], box.end[i]);
  return box;
}

// Clears the nodes of a box.
template <class T, int D>
void clear_box(const Shape<D>& shape, const Box<D>& box, T* nodes, Pool& pool) {
  constexpr Index kRows = 64;
  const Index rows = box.rows(), last = D - 1;
  const Index bytes = (box.end[last] - box.first[last]) * kChannels * sizeof(T);
  pool.run((rows + kRows - 1) / kRows, [&](Index chunk) {
    Index place[D] = {};
    for (Index r = chunk * kRows; r < std::min(rows, (chunk + 1) * kRows); ++r) {
      const Index row = box.row(shape.nodes, r, place);
      std::memset(nodes + (row * shape.nodes[last] + box.first[last]) * kChannels, 0, bytes);
    }
  });
}

// Clears the nodes, then calls `one(b, p, offset, node)` for every particle that fits: its place in
// the cell and the first node of its stencil. No two calls at a time share a node.
template <class T, int D, int K, class F>
void scatter_each(const Shape<D>& shape, Index batch, Batched<const T> xi, Batched<T> g, Pool& pool,
                  const F& one) {
  const auto strides = shape.strides();
  const Index size = shape.node_count() * kChannels;
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    T* out = g.at(b);
    clear(out, size * sizeof(T), pool);
    const Columns<T, D, K> columns(shape, xi.at(b));
    columns.for_each(pool, [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      locate<T, D, K>(shape, xi.at(b) + p * D, first, offset);
      one(b, p, offset, out + offset_of<D>(strides, first));
    });
  });
}

// g = sum_p w (a + B r) + S grad w.
template <class T, int D, int K, bool HasS>
void scatter(const Shape<D>& shape, Index batch, Batched<const T> xi, const Payload<T>& payload,
             Batched<T> g, Pool& pool) {
  const auto strides = shape.strides();
  scatter_each<T, D, K>(shape, batch, xi, g, pool, [&](Index b, Index p, const T* offset, T* node) {
    Axis<T, K> axes[D];
    for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
    const auto c = load_payload<T, D, HasS>(payload, b, p);
    spread<T>(axes, widen(last_axis(axes[D - 1]), c), node, strides.data());
  });
}

// The derivative of `scatter` along (dxi, dpayload).
template <class T, int D, int K, bool HasS>
void scatter_tangent(const Shape<D>& shape, Index batch, Batched<const T> xi,
                     const Payload<T>& payload, Batched<const T> dxi, const Payload<T>& dpayload,
                     Batched<T> dg, Pool& pool) {
  const auto strides = shape.strides();
  scatter_each<T, D, K>(shape, batch, xi, dg, pool, [&](Index b, Index p, const T* offset, T* node) {
    Axis<Dual<T>, K> axes[D];
    for (int i = 0; i < D; ++i) axes[i] = moving_factors<T, K>(offset[i], dxi.at(b)[p * D + i]);
    const auto c = paired(load_payload<T, D, HasS>(payload, b, p),
                          load_payload<T, D, HasS>(dpayload, b, p));
    spread<T>(axes, widen(last_axis(axes[D - 1]), c), node, strides.data());
  });
}

// Calls `one(b, p, offset, at)` for every particle that fits: its place in the cell and where the
// first node of its stencil is. The results of the others are zero.
template <class T, int D, int K, bool HasS, class F>
void gather_each(const Shape<D>& shape, Index batch, Batched<const T> xi, const Moments<T>& out,
                 Pool& pool, const F& one) {
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    for_each_particle(shape.particles, pool, [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      if (locate<T, D, K>(shape, xi.at(b) + p * D, first, offset))
        one(b, p, offset, offset_of<D>(strides, first));
      else
        store_moments<T, D, HasS>(out, b, p, Coefficients<Vec<T>, D, HasS>());
    });
  });
}

// a = sum_i w g, B = sum_i w g r^T, S = sum_i g (grad w)^T.
template <class T, int D, int K, bool HasS>
void gather(const Shape<D>& shape, Index batch, Batched<const T> xi, Batched<const T> g,
            const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  const auto one = [&](Index b, Index p, const T* offset, Index at) {
    Axis<T, K> axes[D];
    for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
    const auto wide =
        collect<T, T, K, Row<T, K>, D - 1, HasS>(axes, g.at(b), at, strides.data());
    // Never assigned to what exists: a copy through memory stalls.
    const auto c = narrow<Vec<T>>(last_axis(axes[D - 1]), wide);
    store_moments<T, D, HasS>(out, b, p, c);
  };
  gather_each<T, D, K, HasS>(shape, batch, xi, out, pool, one);
}

// The derivative of `gather` along (dxi, dg).
template <class T, int D, int K, bool HasS>
void gather_tangent(const Shape<D>& shape, Index batch, Batched<const T> xi, Batched<const T> g,
                    Batched<const T> dxi, Batched<const T> dg, const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  const auto one = [&](Index b, Index p, const T* offset, Index at) {
    Axis<Dual<T>, K> axes[D];
    for (int i = 0; i < D; ++i) axes[i] = moving_factors<T, K>(offset[i], dxi.at(b)[p * D + i]);
    const Dual<const T*> both{g.at(b), dg.at(b)};
    const auto wide = collect<T, Dual<T>, K, Dual<Row<T, K>>, D - 1, HasS>(axes, both, at,
                                                                          strides.data());
    const auto c = tangent_of(narrow<Dual<Vec<T>>>(last_axis(axes[D - 1]), wide));
    store_moments<T, D, HasS>(out, b, p, c);
  };
  gather_each<T, D, K, HasS>(shape, batch, xi, out, pool, one);
}

// The derivative of Phi with respect to the positions and the payload. Positions of particles
// outside get zero.
template <class T, int D, int K, bool HasS>
void pull(const Shape<D>& shape, Index batch, Batched<const T> xi, const Payload<T>& payload,
          Batched<const T> g, Batched<T> dxi, const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  const Index members = dxi.step ? batch : 1;
  clear(dxi.data, members * shape.particles * D * sizeof(T), pool);
  const auto one = [&](Index b, Index p, const T* offset, Index at) {
    Axis<T, K> axes[D], slopes[D];
    for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i], slopes[i]);
    const auto c = load_payload<T, D, HasS>(payload, b, p);
    const auto last = last_axis(axes[D - 1]);
    Row<T, K> along[D - 1] = {};
    const auto wide = differentiate<T, K>(axes, slopes, widen(last, c), g.at(b), at,
                                          strides.data(), along);
    T* to = dxi.at(b) + p * D;
    for (int i = 0; i < D - 1; ++i) to[i] = total(sum(along[i]));
    to[D - 1] = total(sum(product(widen(last_axis(slopes[D - 1]), c), wide)));
    const auto bar = narrow<Vec<T>>(last, wide);
    store_moments<T, D, HasS>(out, b, p, bar);
  };
  gather_each<T, D, K, HasS>(shape, batch, xi, out, pool, one);
}

}  // namespace pgjax
