// Compositing splats front to back, its tangent and its adjoint, on a CPU.
//
//     alpha = min(alpha_max, opacity exp(-sigma)), sigma = p (dx - m dy)^2 + q dy^2
//     w_i = alpha_i T_i,  T_i = prod_{j<i} (1 - alpha_j),  sums = sum_i w_i c_i,  cover = sum_i w_i
//
// An alpha below alpha_min counts as 0, and a ray ends before the splat that would take T to `stop`
// or below. Derivatives are those with the order, the cutoff and the end of the rays held fixed.
// None of them stores an alpha per pixel and splat beyond one chunk of one tile.
//
// A tile of 8 x 8 pixels is a few vectors. Threads share tiles; what a tile adds to a splat has its
// own place, and a splat's places are summed in order: the same sums for any number of threads.
#pragma once

#include <atomic>
#include <memory>
#include <utility>

#include "blocks.h"
#include "lists.h"

namespace pgjax::raster {

#define PGJAX_ALWAYS inline __attribute__((always_inline))

constexpr int kPixels = kTile * kTile;
template <class T>
constexpr int kVectors = kPixels / kGroup<T>;  // in a tile

// 2^x for x <= 0; below the exponents of the type, its smallest normal number. Relative error of
// the polynomial on [-1/2, 1/2]: 2e-9 (float), 3e-18 (double), equioscillating.
template <class T>
constexpr T kExp2[] = {1.0, 6.9314718055994533e-01, 2.4022650695910157e-01, 5.5504108664819888e-02,
                       9.6181291075879503e-03, 1.3333558146795524e-03, 1.5403530462969588e-04,
                       1.5252733486181513e-05, 1.3215432873891146e-06, 1.0178199117494525e-07,
                       7.0741410352729050e-09, 4.4351755974350962e-10};
template <>
constexpr float kExp2<float>[] = {1.0f, 6.9314720573726728e-01f, 2.4022646890634038e-01f,
                                  5.5503287769656136e-02f, 9.6184889571308554e-03f,
                                  1.3399931219141803e-03f, 1.5345811997653676e-04f};

#define PGJAX_UNROLLED _Pragma("GCC unroll 32")

// Of N vectors, step by step for all of them: a processor looks only so far ahead for something
// that does not wait for the step before.
template <class T, int N>
PGJAX_ALWAYS void exp2(Group<T>* x) {
  using V = Group<T>;
  using I = decltype(V{} < V{});
  constexpr bool kSingle = sizeof(T) == 4;
  constexpr int kMantissa = kSingle ? 23 : 52;
  constexpr T kLowest = kSingle ? -126 : -1022;
  // Adding this leaves the nearest whole number in the lowest bits.
  const V shift = V{} + (kSingle ? T(12582912) : T(6755399441055744));
  V shifted[N], sum[N];
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) x[j] = x[j] > kLowest ? x[j] : V{} + kLowest;
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) shifted[j] = x[j] + shift;
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) x[j] -= shifted[j] - shift;
  constexpr int kDegree = sizeof(kExp2<T>) / sizeof(T) - 1;
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) sum[j] = V{} + kExp2<T>[kDegree];
  PGJAX_UNROLLED for (int n = kDegree - 1; n >= 0; --n)
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) sum[j] = sum[j] * x[j] + kExp2<T>[n];
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
    I bits, whole;
    std::memcpy(&bits, &sum[j], sizeof bits);
    std::memcpy(&whole, &shifted[j], sizeof bits);
    bits += whole << kMantissa;
    std::memcpy(&x[j], &bits, sizeof bits);
  }
}

// A vector in a container (as a plain type its alignment would be lost).
template <class T>
struct Lane {
  Group<T> v;
};
template <class T>
using Lanes = std::vector<Lane<T>>;

template <class T>
PGJAX_ALWAYS T sum_of(Group<T> v) {
  T sum = 0;
  for (int l = 0; l < kGroup<T>; ++l) sum += v[l];
  return sum;
}

// Of two vectors that hold sums in blocks of S lanes: the blocks of a and b in turn, half as long.
template <class T, int S, std::size_t... L>
PGJAX_ALWAYS Group<T> fold(Group<T> a, Group<T> b, std::index_sequence<L...>) {
  constexpr int kHalf = S / 2, kOther = kGroup<T>;
  return __builtin_shufflevector(
             a, b, (L / kHalf % 2 * kOther + L / kHalf / 2 * S + L % kHalf)...) +
         __builtin_shufflevector(
             a, b, (L / kHalf % 2 * kOther + L / kHalf / 2 * S + L % kHalf + kHalf)...);
}
template <class T, int S, int Count>
PGJAX_ALWAYS Group<T> folded(const Group<T> (&v)[Count]) {
  if constexpr (S == 1) {
    return v[0];
  } else {
    constexpr int kHalf = (Count + 1) / 2;
    Group<T> half[kHalf];
    PGJAX_UNROLLED for (int i = 0; i < kHalf; ++i) {
      const Group<T> other = 2 * i + 1 < Count ? v[2 * i + 1] : Group<T>{};
      half[i] = fold<T, S>(v[2 * i], other, std::make_index_sequence<kGroup<T>>());
    }
    return folded<T, S / 2, kHalf>(half);
  }
}
// The sums over the lanes of `Count` vectors, of which pairs share a vector ever more often.
template <class T, int Count>
PGJAX_ALWAYS void sums_of(const Group<T>* v, T* to) {
  constexpr int L = kGroup<T>, kNow = Count < L ? Count : L;
  Group<T> some[kNow];
  PGJAX_UNROLLED for (int i = 0; i < kNow; ++i) some[i] = v[i];
  const Group<T> sums = folded<T, L, kNow>(some);
  PGJAX_UNROLLED for (int i = 0; i < kNow; ++i) {
    int lane = 0;  // the bits of i in reverse
    for (int bit = 1, turned = L / 2; turned; bit *= 2, turned /= 2) lane += i & bit ? turned : 0;
    to[i] = sums[lane];
  }
  if constexpr (Count > L) sums_of<T, Count - L>(v + L, to + L);
}

template <class T>
PGJAX_ALWAYS bool is_zero(const Group<T>* v) {
  Group<T> sum = {};
  PGJAX_UNROLLED for (int j = 0; j < kVectors<T>; ++j) sum += v[j];
  return sum_of<T>(sum) == 0;
}

// A splat seen from a tile, and its alphas at the pixels of a vector.
template <class T>
struct Local {
  using V = Group<T>;
  V dx;
  T v, m, p, q, opacity;

  PGJAX_ALWAYS Local(const T* row, T left, T top) {
    constexpr T kLog2e = T(1.44269504088896340736);
    const T u = row[0] - left;
    for (int l = 0; l < kGroup<T>; ++l) dx[l] = T(l % kTile) - u;
    v = row[1] - top, m = row[2], p = row[3] * kLog2e, q = row[4] * kLog2e, opacity = row[5];
  }
  PGJAX_ALWAYS V down(int j) const {
    V rows;
    for (int l = 0; l < kGroup<T>; ++l) rows[l] = T(l / kTile);
    return rows + (T(j * kGroup<T> / kTile) - v);
  }
};

// At the pixels of a tile: alpha (0 where it is not drawn) and -d alpha / d sigma.
template <class T, bool Smooth>
struct Alphas {
  static constexpr int N = kVectors<T>;
  using V = Group<T>;
  V alpha[N], slope[N], s[N], dy[N];

  PGJAX_ALWAYS Alphas(const Local<T>& splat, const Rule<T>& rule) {
    const V zero = {}, one = zero + 1;
    V raw[N];
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) dy[j] = splat.down(j);
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) s[j] = splat.dx - splat.m * dy[j];
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
      raw[j] = -(splat.p * (s[j] * s[j]) + splat.q * (dy[j] * dy[j]));
    }
    exp2<T, N>(raw);
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
      raw[j] *= splat.opacity;
      const auto below = raw[j] < rule.alpha_max;
      alpha[j] = below ? raw[j] : zero + rule.alpha_max;
      const auto drawn = alpha[j] >= rule.alpha_min;
      slope[j] = below ? raw[j] : zero;
      if constexpr (Smooth) {
        // A ramp t^2 (3 - 2 t) of the alpha, from alpha_min to twice that.
        const V t = alpha[j] / rule.alpha_min - 1, in = t < 1 ? t : one;
        const V ramp = in * in * (3 - 2 * in);
        slope[j] *= ramp + alpha[j] * (6 * in * (1 - in) / rule.alpha_min);
        alpha[j] *= ramp;
      }
      alpha[j] = drawn ? alpha[j] : zero;
      slope[j] = drawn ? slope[j] : zero;
    }
  }
};

// Values per pixel of one tile, between an image (height, width, channels) and vectors.
template <class T>
struct Tile {
  const Frame& frame;
  Index number;
  int left, top, width, height;

  Tile(const Frame& frame, Index number)
      : frame(frame), number(number), left(int(number % frame.columns()) * kTile),
        top(int(number / frame.columns()) * kTile), width(std::min(kTile, frame.width - left)),
        height(std::min(kTile, frame.height - top)) {}

  Local<T> local(const T* row) const { return {row, T(left) + T(0.5), T(top) + T(0.5)}; }

  // `vectors` are those of a channel, `step` vectors from one channel to the next.
  void write(const Group<T>* vectors, int step, Index channels, T* image) const {
    each(channels, [&](Index pixel, int at, Index c) {
      image[pixel * channels + c] = reinterpret_cast<const T*>(vectors + c * step)[at];
    });
  }
  void read(const T* image, Index channels, Group<T>* vectors, int step) const {
    const V zero = {};
    for (Index c = 0; c < channels; ++c)
      for (int j = 0; j < kVectors<T>; ++j) vectors[c * step + j] = zero;
    each(channels, [&](Index pixel, int at, Index c) {
      reinterpret_cast<T*>(vectors + c * step)[at] = image[pixel * channels + c];
    });
  }

 private:
  using V = Group<T>;
  template <class F>
  void each(Index channels, const F& f) const {
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        for (Index c = 0; c < channels; ++c)
          f(Index(top + y) * frame.width + left + x, y * kTile + x, c);
  }
};

// Calls `f(worker, tile)` for every tile; `worker` numbers what runs side by side.
template <class F>
void for_each_tile(Pool& pool, Index tiles, const F& f) {
  std::atomic<Index> next{0};
  pool.run(pool.threads(), [&](Index worker) {
    for (Index tile; (tile = next.fetch_add(1)) < tiles;) f(worker, tile);
  });
}

// The number of channels, at compile time for the usual ones (colour and depth).
constexpr int kUsual = 4;
template <class F>
void with_kind(Index channels, bool smooth, const F& f) {
  using std::integral_constant;
  const auto by_smooth = [&](auto K) {
    smooth ? f(K, std::true_type{}) : f(K, std::false_type{});
  };
  channels == kUsual ? by_smooth(integral_constant<int, kUsual>{})
                     : by_smooth(integral_constant<int, 0>{});
}

constexpr int kLook = 16;  // splats between looks whether all rays have ended

template <class T, int K, bool Smooth>
void composite_tile(const Lists<T>& lists, Index number, const Rule<T>& rule, T* sums, T* cover,
                    Group<T>* wide) {
  using V = Group<T>;
  constexpr int N = kVectors<T>;
  const Tile<T> tile(lists.frame, number);
  const Index channels = K ? K : lists.channels;
  const V zero = {};
  V transmitted[N], covered[N], own[K ? K * N : 1];
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) transmitted[j] = zero + 1, covered[j] = zero;
  PGJAX_UNROLLED for (int i = 0; i < K * N; ++i) own[i] = zero;
  if (!K) std::fill_n(wide, channels * N, zero);
  const Index begin = lists.begin[number], end = lists.begin[number + 1];
  for (Index e = begin; e < end; ++e) {
    if ((e - begin) % kLook == kLook - 1 && is_zero<T>(transmitted)) break;
    const T* row = lists.row(lists.entries[e].rank);
    const auto splat = tile.local(row);
    const Alphas<T, Smooth> a(splat, rule);
    V w[N];
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
      w[j] = transmitted[j] * a.alpha[j];
      const V after = transmitted[j] - w[j];
      // A ray that has ended keeps T = 0, and stays so.
      const auto on = after > rule.stop;
      w[j] = on ? w[j] : zero;
      transmitted[j] = on ? after : zero;
      covered[j] += w[j];
      if constexpr (K > 0)
        PGJAX_UNROLLED for (int c = 0; c < K; ++c) own[c * N + j] += w[j] * row[kShape + c];
    }
    if constexpr (K == 0)
      for (Index c = 0; c < channels; ++c)
        for (int j = 0; j < N; ++j) wide[c * N + j] += w[j] * row[kShape + c];
  }
  PGJAX_UNROLLED for (int i = 0; i < K * N; ++i) wide[i] = own[i];
  tile.write(wide, N, channels, sums);
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) wide[j] = covered[j];
  tile.write(wide, N, 1, cover);
}

template <class T>
void composite(const Lists<T>& lists, const Rule<T>& rule, T* sums, T* cover, Pool& pool) {
  const Index wide = std::max<Index>(lists.channels, 1) * kVectors<T>;
  Lanes<T> scratch(pool.threads() * wide);
  with_kind(lists.channels, rule.smooth, [&](auto K, auto Smooth) {
    for_each_tile(pool, lists.frame.tiles(), [&](Index worker, Index tile) {
      composite_tile<T, K, Smooth>(lists, tile, rule, sums, cover, &scratch[worker * wide].v);
    });
  });
}

// Several tangents of the splats of one image: by rank, then by tangent, the six coefficients of
// -d sigma + d opacity / opacity as a polynomial in (1, s, dy, s^2, s dy, dy^2), and the values.
template <class T>
std::vector<T> tangent_rows(const Lists<T>& lists, Index tangents, Index count, const T* dshape,
                            const T* dvalues, Pool& pool) {
  const Index stride = lists.stride(), K = lists.channels;
  std::vector<T> rows(lists.count() * tangents * stride);
  pool.run((lists.count() + 1023) / 1024, [&](Index part) {
    const Index end = std::min(lists.count(), (part + 1) * 1024);
    for (Index rank = part * 1024; rank < end; ++rank)
      for (Index t = 0; t < tangents; ++t) {
        const Index i = t * count + lists.order[rank].index;
        const T *row = lists.row(rank), *d = dshape + i * kShape;
        const T m = row[2], p = row[3], q = row[4], opacity = row[5];
        T* to = rows.data() + (rank * tangents + t) * stride;
        to[0] = d[5] / opacity, to[1] = 2 * p * (d[0] - m * d[1]), to[2] = 2 * q * d[1];
        to[3] = -d[3], to[4] = 2 * p * d[2], to[5] = -d[4];
        std::copy_n(dvalues + i * K, K, to + kShape);
      }
  });
  return rows;
}

// State of a tile for one tangent: dT, the tangent of the cover, those of the sums.
template <class T, int K, bool Smooth>
void tangent_tile(const Lists<T>& lists, const std::vector<T>& drows, Index tangents, Index number,
                  const Rule<T>& rule, T* dsums, T* dcover, Group<T>* state) {
  using V = Group<T>;
  constexpr int N = kVectors<T>;
  const Tile<T> tile(lists.frame, number);
  const Index channels = K ? K : lists.channels, stride = kShape + channels;
  const Index size = (channels + 2) * N, pixels = Index(lists.frame.width) * lists.frame.height;
  const V zero = {};
  std::fill_n(state, tangents * size, zero);
  V transmitted[N];
  for (V& t : transmitted) t = V{} + 1;
  const Index begin = lists.begin[number], end = lists.begin[number + 1];
  for (Index e = begin; e < end; ++e) {
    if ((e - begin) % kLook == kLook - 1 && is_zero<T>(transmitted)) break;
    const Index rank = lists.entries[e].rank;
    const T* row = lists.row(rank);
    const auto splat = tile.local(row);
    Alphas<T, Smooth> a(splat, rule);
    V w[N], moved[N];
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
      w[j] = transmitted[j] * a.alpha[j];
      const V after = transmitted[j] - w[j];
      const auto on = after > rule.stop;
      w[j] = on ? w[j] : zero;
      moved[j] = on ? transmitted[j] * a.slope[j] : zero;
      a.alpha[j] = on ? a.alpha[j] : zero;
      transmitted[j] = on ? after : zero;
    }
    for (Index t = 0; t < tangents; ++t) {
      const T* d = drows.data() + (rank * tangents + t) * stride;
      V *dT = state + t * size, *covered = dT + N, *acc = covered + N;
      PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
        const V s = a.s[j], dy = a.dy[j];
        const V growth = d[0] + s * (d[1] + s * d[3] + dy * d[4]) + dy * (d[2] + dy * d[5]);
        // Where nothing moves, the polynomial of a degenerate splat may overflow.
        const V dw = dT[j] * a.alpha[j] + (moved[j] != 0 ? moved[j] * growth : zero);
        dT[j] -= dw;
        covered[j] += dw;
        for (Index c = 0; c < channels; ++c)
          acc[c * N + j] += dw * row[kShape + c] + w[j] * d[kShape + c];
      }
    }
  }
  for (Index t = 0; t < tangents; ++t) {
    const V* covered = state + t * size + N;
    tile.write(covered + N, N, channels, dsums + t * pixels * channels);
    tile.write(covered, N, 1, dcover + t * pixels);
  }
}

// All tangents (each of `count` splats) in one pass over the alphas.
template <class T>
void tangent(const Lists<T>& lists, const Rule<T>& rule, Index tangents, Index count,
             const T* dshape, const T* dvalues, T* dsums, T* dcover, Pool& pool) {
  const auto drows = tangent_rows(lists, tangents, count, dshape, dvalues, pool);
  const Index size = tangents * (lists.channels + 2) * kVectors<T>;
  Lanes<T> scratch(pool.threads() * size);
  with_kind(lists.channels, rule.smooth, [&](auto K, auto Smooth) {
    for_each_tile(pool, lists.frame.tiles(), [&](Index worker, Index tile) {
      tangent_tile<T, K, Smooth>(lists, drows, tangents, tile, rule, dsums, dcover,
                                 &scratch[worker * size].v);
    });
  });
}

// The adjoint walks a tile forwards in chunks, keeping alpha and T of the last chunk and T at the
// start of each, and then backwards, chunk by chunk. With B the value behind a splat, from
// B <- B + alpha (phi - B), where phi = cotangent . values, the derivative is
// d/d alpha = T (phi - B): nothing is divided, and no difference of large sums is taken.
constexpr int kChunk = 128;

template <class T>
struct Kept {
  Group<T> alpha[kVectors<T>], slope[kVectors<T>], before[kVectors<T>];
};

template <class T>
struct AdjointScratch {
  std::vector<Kept<T>> kept = std::vector<Kept<T>>(kChunk);
  Lanes<T> cotangent;  // of the cover, then of the channels
  Lanes<T> start;      // T at the start of each chunk
  Lanes<T> values;     // cotangents of the channels
};

// Splats [begin, end) of a tile from T; returns whether any ray still goes on.
template <class T, bool Smooth>
bool keep(const Lists<T>& lists, const Tile<T>& tile, Index begin, Index end, const Rule<T>& rule,
          Group<T>* transmitted, Kept<T>* kept) {
  using V = Group<T>;
  constexpr int N = kVectors<T>;
  const V zero = {};
  V now[N];
  std::copy_n(transmitted, N, now);
  for (Index e = begin; e < end; ++e, ++kept) {
    const auto splat = tile.local(lists.row(lists.entries[e].rank));
    const Alphas<T, Smooth> a(splat, rule);
    PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
      const V after = now[j] - now[j] * a.alpha[j];
      const auto on = after > rule.stop;
      kept->alpha[j] = on ? a.alpha[j] : zero;
      if (Smooth) kept->slope[j] = on ? a.slope[j] : zero;
      kept->before[j] = now[j];
      now[j] = on ? after : zero;
    }
  }
  std::copy_n(now, N, transmitted);
  return !is_zero<T>(now);
}

// Turns the moments of -sigma's derivative into cotangents of the shape.
template <class T>
PGJAX_ALWAYS void shape_cotangent(const T* row, const T* moment, T* to) {
  const T m = row[2], p = row[3], q = row[4], opacity = row[5];
  to[0] = 2 * p * moment[1];
  to[1] = 2 * q * moment[2] - 2 * p * m * moment[1];
  to[2] = 2 * p * moment[4];
  to[3] = -moment[3];
  to[4] = -moment[5];
  to[5] = moment[0] / opacity;
}

template <class T, int K, bool Smooth>
void adjoint_splat(const T* row, const Local<T>& splat, const Kept<T>& kept, const Rule<T>& rule,
                   Index channels, const Group<T>* g, Group<T>* behind, Group<T>* values,
                   T* to) {
  using V = Group<T>;
  constexpr int N = kVectors<T>;
  const V zero = {};
  V shape[kShape] = {}, own[K ? K : 1] = {};
  if (!K) std::fill_n(values, channels, zero);
  PGJAX_UNROLLED for (int j = 0; j < N; ++j) {
    const V alpha = kept.alpha[j], dy = splat.down(j), sheared = splat.dx - splat.m * dy;
    const V slope = Smooth ? kept.slope[j] : (alpha < rule.alpha_max ? alpha : zero);
    const V s = slope != 0 ? sheared : zero;  // may overflow elsewhere
    V phi = g[j];
    for (Index c = 0; c < channels; ++c) phi += g[(c + 1) * N + j] * row[kShape + c];
    const V gain = phi - behind[j], w = kept.before[j] * alpha;
    behind[j] += alpha * gain;
    const V h = slope * kept.before[j] * gain, hs = h * s, hy = h * dy;
    shape[0] += h, shape[1] += hs, shape[2] += hy;
    shape[3] += hs * s, shape[4] += hs * dy, shape[5] += hy * dy;
    if constexpr (K > 0)
      PGJAX_UNROLLED for (int c = 0; c < K; ++c) own[c] += w * g[(c + 1) * N + j];
    else
      for (Index c = 0; c < channels; ++c) values[c] += w * g[(c + 1) * N + j];
  }
  if constexpr (K > 0) {
    V all[kShape + K];
    PGJAX_UNROLLED for (int i = 0; i < kShape; ++i) all[i] = shape[i];
    PGJAX_UNROLLED for (int c = 0; c < K; ++c) all[kShape + c] = own[c];
    sums_of<T, kShape + K>(all, to);
  } else {
    sums_of<T, kShape>(shape, to);
    for (Index c = 0; c < channels; ++c) to[kShape + c] = sum_of<T>(values[c]);
  }
}

template <class T, int K, bool Smooth>
void adjoint_tile(const Lists<T>& lists, Index number, const Rule<T>& rule, const T* gsums,
                  const T* gcover, AdjointScratch<T>& scratch, T* partial) {
  using V = Group<T>;
  constexpr int N = kVectors<T>;
  const Tile<T> tile(lists.frame, number);
  const Index channels = K ? K : lists.channels, stride = kShape + channels;
  const Index begin = lists.begin[number], end = lists.begin[number + 1];
  if (begin == end) return;
  scratch.cotangent.resize((channels + 1) * N);
  scratch.values.resize(channels + 1);
  V *g = &scratch.cotangent[0].v, *values = &scratch.values[0].v;
  tile.read(gcover, 1, g, N);
  tile.read(gsums, channels, g + N, N);

  V transmitted[N], behind[N] = {};
  for (V& t : transmitted) t = V{} + 1;
  scratch.start.clear();
  Index chunk = begin;
  for (;; chunk += kChunk) {
    for (const V& t : transmitted) scratch.start.push_back({t});
    const Index stop = std::min(end, chunk + kChunk);
    const bool on = keep<T, Smooth>(lists, tile, chunk, stop, rule, transmitted, scratch.kept.data());
    if (on && stop < end) continue;
    // Behind the end of all rays.
    for (Index e = stop; e < end; ++e)
      std::fill_n(partial + lists.entries[e].pair * stride, stride, T(0));
    break;
  }
  for (bool last = true;; last = false, chunk -= kChunk) {
    const Index stop = std::min(end, chunk + kChunk);
    if (!last) {
      for (int j = 0; j < N; ++j) transmitted[j] = scratch.start[(chunk - begin) / kChunk * N + j].v;
      keep<T, Smooth>(lists, tile, chunk, stop, rule, transmitted, scratch.kept.data());
    }
    for (Index e = stop - 1; e >= chunk; --e) {
      const T* row = lists.row(lists.entries[e].rank);
      adjoint_splat<T, K, Smooth>(row, tile.local(row), scratch.kept[e - chunk], rule, channels, g,
                                  behind, values, partial + lists.entries[e].pair * stride);
    }
    if (chunk == begin) break;
  }
}

// Cotangents of all splats; `shape` and `values` are zero before.
template <class T>
void adjoint(const Lists<T>& lists, const Rule<T>& rule, const T* gsums, const T* gcover, T* shape,
             T* values, Pool& pool) {
  const Index K = lists.channels, stride = lists.stride();
  const std::unique_ptr<T[]> partial(new T[lists.pairs * stride]);
  std::vector<AdjointScratch<T>> scratch(pool.threads());
  with_kind(K, rule.smooth, [&](auto Kind, auto Smooth) {
    for_each_tile(pool, lists.frame.tiles(), [&](Index worker, Index tile) {
      adjoint_tile<T, Kind, Smooth>(lists, tile, rule, gsums, gcover, scratch[worker],
                                    partial.get());
    });
  });
  pool.run((lists.count() + 1023) / 1024, [&](Index part) {
    std::vector<T> sums(stride);
    const Index end = std::min(lists.count(), (part + 1) * 1024);
    for (Index rank = part * 1024; rank < end; ++rank) {
      std::fill(sums.begin(), sums.end(), T(0));
      for (Index pair = lists.first_pair[rank]; pair < lists.first_pair[rank + 1]; ++pair)
        for (Index i = 0; i < stride; ++i) sums[i] += partial[pair * stride + i];
      const Index splat = lists.order[rank].index;
      shape_cotangent(lists.row(rank), sums.data(), shape + splat * kShape);
      std::copy_n(sums.data() + kShape, K, values + splat * K);
    }
  });
}

}  // namespace pgjax::raster
