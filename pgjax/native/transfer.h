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

template <class T>
inline Vec<T> load(const T* p) {
  Vec<T> v;
  std::memcpy(&v, p, sizeof v);
  return v;
}

template <class T>
inline void add_to(T* p, Vec<T> v) {
  v += load(p);
  std::memcpy(p, &v, sizeof v);
}

// A value and its derivative along one direction.
template <class N>
struct Dual {
  N v, d;
};
template <class W, class N>
inline N times(W w, N n) {
  if constexpr (std::is_arithmetic_v<W>) {
    return w * n;
  } else {
    return {w.v * n.v, w.v * n.d + w.d * n.v};
  }
}
template <class N>
inline void plus(N& a, N b) {
  a += b;
}
template <class N>
inline void plus(Dual<N>& a, Dual<N> b) {
  a.v += b.v;
  a.d += b.d;
}

// Factors along one direction at the K nodes of a stencil; r = x_i - x_p.
template <class W, int K>
struct Axis {
  W w[K], wr[K], dw[K];
};

// First node of the stencil, in cells.
template <class T, int K>
inline T first_node(T xi) {
  return std::floor(xi - T(K - 2) / 2);
}

// Weights of the B-spline of degree K - 1, and their first and second derivatives.
template <class T, int K>
inline void spline(T offset, T w[K], T dw[K], T ddw[K]) {
  if constexpr (K == 3) {
    const T a = T(1.5) - offset, b = offset - 1, c = offset - T(0.5);
    w[0] = a * a / 2, w[1] = T(0.75) - b * b, w[2] = c * c / 2;
    dw[0] = -a, dw[1] = -2 * b, dw[2] = c;
    ddw[0] = 1, ddw[1] = -2, ddw[2] = 1;
  } else {
    // s^3/6 and t^3/6 cancel in the sums, as in pgjax/splines.py.
    const T t = offset - 1, s = 1 - t;
    const T a = s * s * s / 6, b = t * t * t / 6, da = -s * s / 2, db = t * t / 2;
    w[0] = a, w[1] = s - (2 * a - b), w[2] = t - (2 * b - a), w[3] = b;
    dw[0] = da, dw[1] = -1 - (2 * da - db), dw[2] = 1 - (2 * db - da), dw[3] = db;
    ddw[0] = s, ddw[1] = t - 2 * s, ddw[2] = s - 2 * t, ddw[3] = t;
  }
}

template <class T, int K>
inline void factors(T offset, Axis<T, K>& value) {
  T ddw[K];
  spline<T, K>(offset, value.w, value.dw, ddw);
  for (int i = 0; i < K; ++i) value.wr[i] = value.w[i] * (i - offset);
}

// The factors and their derivatives with respect to the position (in cells).
template <class T, int K>
inline void factors(T offset, Axis<T, K>& value, Axis<T, K>& slope) {
  spline<T, K>(offset, value.w, value.dw, slope.dw);
  for (int i = 0; i < K; ++i) {
    const T r = i - offset;
    value.wr[i] = value.w[i] * r;
    slope.w[i] = value.dw[i];
    slope.wr[i] = value.dw[i] * r - value.w[i];
  }
}

// What is left of a payload after some directions: M of them are still to come.
template <class N, int M, bool HasS>
struct Coefficients {
  N A;
  std::array<N, M> B;
  std::array<N, HasS ? M : 0> S;
};

template <class W, int K, class N, int M, bool HasS>
inline Coefficients<N, M - 1, HasS> descend(const Axis<W, K>& axis, int i,
                                            const Coefficients<N, M, HasS>& c) {
  Coefficients<N, M - 1, HasS> n;
  n.A = times(axis.w[i], c.A);
  plus(n.A, times(axis.wr[i], c.B[0]));
  if constexpr (HasS) plus(n.A, times(axis.dw[i], c.S[0]));
  for (int m = 1; m < M; ++m) {
    n.B[m - 1] = times(axis.w[i], c.B[m]);
    if constexpr (HasS) n.S[m - 1] = times(axis.w[i], c.S[m]);
  }
  return n;
}

// The transpose of `descend`.
template <class W, int K, class N, int M, bool HasS>
inline void ascend(const Axis<W, K>& axis, int i, const Coefficients<N, M - 1, HasS>& n,
                   Coefficients<N, M, HasS>& c) {
  plus(c.A, times(axis.w[i], n.A));
  plus(c.B[0], times(axis.wr[i], n.A));
  if constexpr (HasS) plus(c.S[0], times(axis.dw[i], n.A));
  for (int m = 1; m < M; ++m) {
    plus(c.B[m], times(axis.w[i], n.B[m - 1]));
    if constexpr (HasS) plus(c.S[m], times(axis.w[i], n.S[m - 1]));
  }
}

// Scatter of one particle: `node` is the first node that is left of its stencil.
template <class T, class W, int K, class N, int M, bool HasS>
inline void spread(const Axis<W, K>* axes, const Coefficients<N, M, HasS>& c, T* node,
                   const Index* stride) {
#pragma GCC unroll 4
  for (int i = 0; i < K; ++i, node += *stride) {
    const auto n = descend(*axes, i, c);
    if constexpr (M > 1) {
      spread(axes + 1, n, node, stride + 1);
    } else if constexpr (std::is_same_v<N, Vec<T>>) {
      add_to(node, n.A);
    } else {
      add_to(node, n.A.d);
    }
  }
}

template <class T>
inline void read(const T* g, Index at, Vec<T>& out) {
  out = load(g + at);
}
template <class T>
inline void read(Dual<const T*> g, Index at, Dual<Vec<T>>& out) {
  out = {load(g.v + at), load(g.d + at)};
}

// Gather of one particle.
template <class T, class W, int K, class N, int M, bool HasS, class G>
inline Coefficients<N, M, HasS> collect(const Axis<W, K>* axes, G g, Index at,
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

// The derivative of Phi with respect to position (into `pull`, to be summed over its lanes) and
// payload (returned), at payload c and node values g.
template <class T, int K, int M, bool HasS>
inline Coefficients<Vec<T>, M, HasS> differentiate(const Axis<T, K>* axes, const Axis<T, K>* slopes,
                                                   const Coefficients<Vec<T>, M, HasS>& c,
                                                   const T* g, Index at, const Index* stride,
                                                   Vec<T>* pull) {
  Coefficients<Vec<T>, M, HasS> bar{};
#pragma GCC unroll 4
  for (int i = 0; i < K; ++i, at += *stride) {
    Coefficients<Vec<T>, M - 1, HasS> n;
    if constexpr (M > 1) {
      n = differentiate(axes + 1, slopes + 1, descend(*axes, i, c), g, at, stride + 1, pull + 1);
    } else {
      n.A = load(g + at);
    }
    const auto moved = descend(*slopes, i, c);
    *pull += moved.A * n.A;
    for (int m = 0; m < M - 1; ++m) {
      *pull += moved.B[m] * n.B[m];
      if constexpr (HasS) *pull += moved.S[m] * n.S[m];
    }
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

// What does not depend on the particle. `c` channels of a payload, `m` of which have a gradient.
template <int D>
struct Shape {
  Index particles, nodes[D];
  int c, m;

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
inline bool locate(const Shape<D>& shape, const T* xi, Index first[D], T offset[D]) {
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
inline Index offset_of(const std::array<Index, D>& strides, const Index first[D]) {
  Index at = 0;
  for (int i = 0; i < D; ++i) at += first[i] * strides[i];
  return at;
}

template <class T>
inline Vec<T> load_some(const T* p, int n, int step) {
  Vec<T> v{};
  for (int i = 0; i < kChannels; ++i)
    if (i < n) v[i] = p[i * step];
  return v;
}
template <class T>
inline void store_some(T* p, int n, int step, Vec<T> v) {
  for (int i = 0; i < kChannels; ++i)
    if (i < n) p[i * step] = v[i];
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
inline Coefficients<Vec<T>, D, HasS> load_payload(const Shape<D>& shape, const Payload<T>& from,
                                                  Index b, Index p) {
  Coefficients<Vec<T>, D, HasS> c;
  c.A = load_some(from.a.at(b) + p * shape.c, shape.c, 1);
  const Index row = p * shape.m * D;
  for (int j = 0; j < D; ++j) {
    c.B[j] = load_some(from.B.at(b) + row + j, shape.m, D);
    if constexpr (HasS) c.S[j] = load_some(from.S.at(b) + row + j, shape.m, D);
  }
  return c;
}

template <class T, int D, bool HasS>
inline void store_moments(const Shape<D>& shape, const Moments<T>& to, Index b, Index p,
                          const Coefficients<Vec<T>, D, HasS>& c) {
  store_some(to.a.at(b) + p * shape.c, shape.c, 1, c.A);
  const Index row = p * shape.m * D;
  for (int j = 0; j < D; ++j) {
    store_some(to.B.at(b) + row + j, shape.m, D, c.B[j]);
    if constexpr (HasS) store_some(to.S.at(b) + row + j, shape.m, D, c.S[j]);
  }
}

template <class V, int D, bool HasS>
inline Coefficients<Dual<V>, D, HasS> paired(const Coefficients<V, D, HasS>& v,
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
inline Coefficients<V, D, HasS> tangent_of(const Coefficients<Dual<V>, D, HasS>& c) {
  Coefficients<V, D, HasS> d;
  d.A = c.A.d;
  for (int j = 0; j < D; ++j) {
    d.B[j] = c.B[j].d;
    if constexpr (HasS) d.S[j] = c.S[j].d;
  }
  return d;
}

template <class T, int K>
inline Axis<Dual<T>, K> moving_factors(T offset, T speed) {
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
    for (const auto& colour : colours_) {
      pool.run(Index(colour.size()), [&](Index i) {
        const Index k = colour[i];
        for (Index j = start_[k]; j < start_[k + 1]; ++j) scatter(order_[j]);
      });
    }
  }

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
    spread<T>(axes, load_payload<T, D, HasS>(shape, payload, b, p), node, strides.data());
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
    const auto c = paired(load_payload<T, D, HasS>(shape, payload, b, p),
                          load_payload<T, D, HasS>(shape, dpayload, b, p));
    spread<T>(axes, c, node, strides.data());
  });
}

// a = sum_i w g, B = sum_i w g r^T, S = sum_i g (grad w)^T.
template <class T, int D, int K, bool HasS>
void gather(const Shape<D>& shape, Index batch, Batched<const T> xi, Batched<const T> g,
            const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    for_each_particle(shape.particles, pool, [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      Coefficients<Vec<T>, D, HasS> c{};
      if (locate<T, D, K>(shape, xi.at(b) + p * D, first, offset)) {
        Axis<T, K> axes[D];
        for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
        c = collect<T, T, K, Vec<T>, D, HasS>(axes, g.at(b), offset_of<D>(strides, first),
                                              strides.data());
      }
      store_moments<T, D, HasS>(shape, out, b, p, c);
    });
  });
}

// The derivative of `gather` along (dxi, dg).
template <class T, int D, int K, bool HasS>
void gather_tangent(const Shape<D>& shape, Index batch, Batched<const T> xi, Batched<const T> g,
                    Batched<const T> dxi, Batched<const T> dg, const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    for_each_particle(shape.particles, pool, [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      Coefficients<Vec<T>, D, HasS> c{};
      if (locate<T, D, K>(shape, xi.at(b) + p * D, first, offset)) {
        Axis<Dual<T>, K> axes[D];
        for (int i = 0; i < D; ++i)
          axes[i] = moving_factors<T, K>(offset[i], dxi.at(b)[p * D + i]);
        const Dual<const T*> both{g.at(b), dg.at(b)};
        c = tangent_of(collect<T, Dual<T>, K, Dual<Vec<T>>, D, HasS>(
            axes, both, offset_of<D>(strides, first), strides.data()));
      }
      store_moments<T, D, HasS>(shape, out, b, p, c);
    });
  });
}

// The derivative of Phi with respect to the positions and the payload.
template <class T, int D, int K, bool HasS>
void pull(const Shape<D>& shape, Index batch, Batched<const T> xi, const Payload<T>& payload,
          Batched<const T> g, Batched<T> dxi, const Moments<T>& out, Pool& pool) {
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    for_each_particle(shape.particles, pool, [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      Coefficients<Vec<T>, D, HasS> bar{};
      Vec<T> along[D] = {};
      if (locate<T, D, K>(shape, xi.at(b) + p * D, first, offset)) {
        Axis<T, K> axes[D], slopes[D];
        for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i], slopes[i]);
        const auto c = load_payload<T, D, HasS>(shape, payload, b, p);
        bar = differentiate<T, K>(axes, slopes, c, g.at(b), offset_of<D>(strides, first),
                                  strides.data(), along);
      }
      for (int i = 0; i < D; ++i)
        dxi.at(b)[p * D + i] = along[i][0] + along[i][1] + along[i][2] + along[i][3];
      store_moments<T, D, HasS>(shape, out, b, p, bar);
    });
  });
}

}  // namespace pgjax
