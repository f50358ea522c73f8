// Eigenvalues and eigenvectors of symmetric 3 x 3 matrices, and the singular value decomposition of
// any, several at a time.
//
// Jacobi, the same rotations as `pgjax.linalg.eigenbasis` and `svd`, without branches: each number
// is a vector of the same entry of a whole group of matrices.
#pragma once

#include <cstdint>
#include <limits>
#include <type_traits>

#include "blocks.h"

namespace pgjax {

// Rotates the basis in the plane (i, j) so that the entry `off` of the matrix vanishes.
template <class V>
inline void rotate(V& ii, V& jj, V& off, V& ki, V& kj, V qi[3], V qj[3]) {
  const V zero = {}, one = zero + 1;
  const V gap = jj - ii, size = gap < 0 ? -gap : gap;
  const V below = size + root(gap * gap + 4 * off * off);
  const V tangent = 2 * off / (below > 0 ? below : one);
  const V t = gap < 0 ? -tangent : tangent;
  const V c = 1 / root(1 + t * t), s = t * c;
  // c u - s v as u - s (v + s/(1 + c) u): only the change is rounded (Rutishauser 1966).
  const V half = s / (1 + c);
  ii -= t * off, jj += t * off, off = zero;
  const V u = ki, v = kj;
  ki = u - s * (v + half * u), kj = v + s * (u - half * v);
  for (int m = 0; m < 3; ++m) {
    const V x = qi[m], y = qj[m];
    qi[m] = x - s * (y + half * x), qj[m] = y + s * (x - half * y);
  }
}

template <class V>
inline void put_larger_first(V& wi, V& wj, V qi[3], V qj[3]) {
  const auto swap = wi < wj;
  const V a = wi, b = wj;
  wi = swap ? b : a, wj = swap ? a : b;
  for (int m = 0; m < 3; ++m) {
    const V x = qi[m], y = qj[m];
    qi[m] = swap ? y : x, qj[m] = swap ? x : y;
  }
}

// The largest magnitude of N entries, or 1 if all are 0.
template <int N, class V>
inline V largest(const V* a) {
  const V zero = {}, one = zero + 1;
  V scale = zero;
  for (int i = 0; i < N; ++i) {
    const V size = a[i] < 0 ? -a[i] : a[i];
    scale = size > scale ? size : scale;
  }
  return scale > 0 ? scale : one;
}

template <class V>
constexpr int kSweeps = sizeof(V{}[0]) == sizeof(float) ? 4 : 6;

// One group: the six entries in `a` (00, 11, 22, 01, 02, 12), eigenvalues and basis out, the
// columns of which are the vectors.
template <class V>
inline void diagonalise(const V a[6], V w[3], V q[9]) {
  const V zero = {}, one = zero + 1;
  const V scale = largest<6>(a);
  V a00 = a[0] / scale, a11 = a[1] / scale, a22 = a[2] / scale;
  V a01 = a[3] / scale, a02 = a[4] / scale, a12 = a[5] / scale;
  V q0[3] = {one, zero, zero}, q1[3] = {zero, one, zero}, q2[3] = {zero, zero, one};
  for (int sweep = 0; sweep < kSweeps<V>; ++sweep) {
    rotate(a00, a11, a01, a02, a12, q0, q1);
    rotate(a00, a22, a02, a01, a12, q0, q2);
    rotate(a11, a22, a12, a01, a02, q1, q2);
  }
  put_larger_first(a00, a11, q0, q1);
  put_larger_first(a00, a22, q0, q2);
  put_larger_first(a11, a22, q1, q2);
  w[0] = a00 * scale, w[1] = a11 * scale, w[2] = a22 * scale;
  for (int m = 0; m < 3; ++m) q[3 * m] = q0[m], q[3 * m + 1] = q1[m], q[3 * m + 2] = q2[m];
}

template <class V>
inline V dot(const V a[3], const V b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class V>
inline void turn(V c, V s, V x[3], V y[3]) {
  for (int m = 0; m < 3; ++m) {
    const V a = x[m], b = y[m];
    x[m] = c * a - s * b, y[m] = s * a + c * b;
  }
}

// Turns two columns of G = F V, and of V, until they are perpendicular (Hestenes 1958).
template <class V>
inline void make_perpendicular(V gi[3], V gj[3], V vi[3], V vj[3]) {
  const V one = V{} + 1, off = dot(gi, gj), gap = dot(gj, gj) - dot(gi, gi);
  const V size = gap < 0 ? -gap : gap, below = size + root(gap * gap + 4 * off * off);
  const V tangent = 2 * off / (below > 0 ? below : one);
  const V t = gap < 0 ? -tangent : tangent;
  const V c = 1 / root(1 + t * t), s = t * c;
  turn(c, s, gi, gj), turn(c, s, vi, vj);
}

// The longer column first; a quarter turn, not an exchange: det V stays 1.
template <class V>
inline void put_longer_first(V& si, V& sj, V gi[3], V gj[3], V vi[3], V vj[3]) {
  const auto swap = si < sj;
  const V a = si, b = sj;
  si = swap ? b : a, sj = swap ? a : b;
  V* pairs[2][2] = {{gi, gj}, {vi, vj}};
  for (auto& pair : pairs)
    for (int m = 0; m < 3; ++m) {
      const V x = pair[0][m], y = pair[1][m];
      pair[0][m] = swap ? y : x, pair[1][m] = swap ? -x : y;
    }
}

template <class V>
inline void cross(const V a[3], const V b[3], V c[3]) {
  c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

// F = U diag(sigma) V^T with rotations U and V; the last sigma has the sign of det F.
template <class V>
inline void decompose(const V f[9], V u_out[9], V sigma[3], V v_out[9]) {
  using T = std::decay_t<decltype(V{}[0])>;
  const V zero = {}, one = zero + 1;
  const V scale = largest<9>(f);
  V g[3][3], v[3][3];  // columns
  for (int j = 0; j < 3; ++j)
    for (int i = 0; i < 3; ++i) g[j][i] = f[3 * i + j] / scale, v[j][i] = i == j ? one : zero;
  for (int sweep = 0; sweep < kSweeps<V> + 1; ++sweep) {
    make_perpendicular(g[0], g[1], v[0], v[1]);
    make_perpendicular(g[0], g[2], v[0], v[2]);
    make_perpendicular(g[1], g[2], v[1], v[2]);
  }
  V square[3];
  for (int j = 0; j < 3; ++j) square[j] = dot(g[j], g[j]);
  put_longer_first(square[0], square[1], g[0], g[1], v[0], v[1]);
  put_longer_first(square[0], square[2], g[0], g[2], v[0], v[2]);
  put_longer_first(square[1], square[2], g[1], g[2], v[1], v[2]);

  V u[3][3];
  const auto some = square[0] > 0;
  const V length = root(some ? dot(g[0], g[0]) : one);
  for (int i = 0; i < 3; ++i) u[0][i] = some ? g[0][i] / length : (i == 0 ? one : zero);
  const V along = dot(u[0], g[1]);
  V rest[3], other[3];
  for (int i = 0; i < 3; ++i) rest[i] = g[1][i] - along * u[0][i];
  constexpr T eps = std::numeric_limits<T>::epsilon();
  const auto flat = square[1] <= eps * eps * square[0];
  // A unit vector perpendicular to the first (Duff et al. 2017).
  const V sign = u[0][2] < 0 ? -one : one, a = -1 / (sign + u[0][2]);
  other[0] = 1 + sign * u[0][0] * u[0][0] * a, other[1] = sign * u[0][0] * u[0][1] * a;
  other[2] = -sign * u[0][0];
  const V across = root(flat ? one : dot(rest, rest));
  for (int i = 0; i < 3; ++i) u[1][i] = flat ? other[i] : rest[i] / across;
  const V left = dot(u[0], u[1]);
  for (int i = 0; i < 3; ++i) u[1][i] -= left * u[0][i];
  const V again = root(dot(u[1], u[1]));
  for (int i = 0; i < 3; ++i) u[1][i] /= again;
  cross(u[0], u[1], u[2]);
  for (int j = 0; j < 3; ++j) {
    sigma[j] = dot(u[j], g[j]) * scale;
    for (int i = 0; i < 3; ++i) u_out[3 * i + j] = u[j][i], v_out[3 * i + j] = v[j][i];
  }
}

// `count` matrices (3, 3) in rows; eigenvalues (3), largest first, and vectors in columns (3, 3).
template <class T>
void eigenbasis(std::int64_t count, const T* A, T* w, T* Q, Pool& pool) {
  using V = Group<T>;
  const Column<const T> ins[] = {{A, 9}};
  const Column<T> outs[] = {{w, 3}, {Q, 9}};
  for_each_block<T, 9, 12>(count, ins, outs, pool, [](const V* a, V* made) {
    const V symmetric[6] = {a[0], a[4], a[8], a[1], a[2], a[5]};
    diagonalise(symmetric, made, made + 3);
  });
}

// `count` matrices (3, 3) in rows; U (3, 3), sigma (3), V (3, 3).
template <class T>
void svd(std::int64_t count, const T* F, T* U, T* sigma, T* V, Pool& pool) {
  const Column<const T> ins[] = {{F, 9}};
  const Column<T> outs[] = {{U, 9}, {sigma, 3}, {V, 9}};
  for_each_block<T, 9, 21>(count, ins, outs, pool, [](const Group<T>* f, Group<T>* made) {
    decompose(f, made, made + 9, made + 12);
  });
}

}  // namespace pgjax
