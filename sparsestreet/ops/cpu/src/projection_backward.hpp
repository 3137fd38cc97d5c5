// From the sums over pixels back to the parameters, a register of visible rows at a time: slots of a row are summed in
// a fixed order.
#pragma once
#include <omp.h>

#include "prepare.hpp"

namespace SPLAT_VARIANT {

// Gradients of one splat on the screen, in natural units (exponent -|L d|^2 / 2).
template <class V>
struct ScreenGradient {
  V x, y, abs_x, abs_y, l11, l21, l22;
  V log_opacity;
  Vector<V> color;
  V depth;
};

// ln alpha = ln o - ln 2 |L d|^2 with the record's L, which is the Cholesky factor times k = LOG2_SCALE.
template <class V>
inline ScreenGradient<V> screen_gradient(const Slot<V>& sum, const Splat<V>& s) {
  using T = Scalar<V>;
  const T two_ln2 = T(TWO_LN2);
  ScreenGradient<V> g;
  g.x = two_ln2 * s.l11 * sum.sa;
  g.y = two_ln2 * (s.l21 * sum.sa + s.l22 * sum.sb);
  g.abs_x = two_ln2 * s.l11 * sum.abs_x, g.abs_y = two_ln2 * sum.abs_y;
  g.l11 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dx;
  g.l21 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dy;
  g.l22 = -two_ln2 * T(LOG2_SCALE) * sum.sb_dy;
  g.log_opacity = sum.s;
  g.color = {sum.color[0], sum.color[1], sum.color[2]};
  g.depth = sum.depth;
  return g;
}

// Gradients of the rows of V.
template <class V>
struct FactorGradient {
  Vector<V> x, y;
};

// Through l11 = sqrt(C / det), l21 = -B / sqrt(C det), l22 = 1 / sqrt(C) with C = |Vy|^2 + blur, B = Vx . Vy and
// det = |Vx x Vy|^2 + blur |V|^2 + blur^2, and through the antialias compensation sqrt(|Vx x Vy|^2 / det).
template <class T, class V>
inline FactorGradient<V> factor_backward(const Camera<T>& camera, const Projection<V>& p, const ScreenGradient<V>& g) {
  const V root_of_both = root(p.variance_y) * root(p.determinant);
  const V l11 = root(p.variance_y / p.determinant), l21 = -p.covariance / root_of_both, l22 = 1 / root(p.variance_y);
  const V v_variance = (g.l11 * l11 - g.l21 * l21 - g.l22 * l22) / (2 * p.variance_y);
  const V v_covariance = -g.l21 / root_of_both;
  V v_cross = -(g.l11 * l11 + g.l21 * l21) / (2 * p.determinant);  // of |Vx x Vy|^2
  V v_square = v_cross * camera.blur;                              // of |V|^2
  if (camera.antialias) {
    // d ratio = ((1 - ratio) d|Vx x Vy|^2 - ratio blur d|V|^2) / det, and the logarithm of the opacity holds ratio / 2.
    const V ratio = p.bare_determinant / p.determinant;
    const V v_ratio = ratio > T(COMPENSATION_FLOOR) ? g.log_opacity / (2 * ratio) : V{};
    v_cross += v_ratio * (1 - ratio) / p.determinant;
    v_square -= v_ratio * ratio * camera.blur / p.determinant;
  }
  const Vector<V> c = cross(p.factor_x, p.factor_y);
  return {(2 * v_cross) * cross(p.factor_y, c) + (2 * v_square) * p.factor_x + v_covariance * p.factor_y,
          (2 * v_cross) * cross(c, p.factor_x) + (2 * (v_square + v_variance)) * p.factor_y +
              v_covariance * p.factor_x};
}

template <class V>
inline void quaternion_backward(const Projection<V>& p, const Matrix<V>& v, V* out) {
  const V w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  const Vector<V>&a = v.rows[0], &b = v.rows[1], &c = v.rows[2];
  const V g[4] = {2 * (x * (c.y - b.z) + y * (a.z - c.x) + z * (b.x - a.y)),
                  2 * (w * (c.y - b.z) + y * (a.y + b.x) + z * (a.z + c.x)) - 4 * x * (b.y + c.z),
                  2 * (w * (a.z - c.x) + x * (a.y + b.x) + z * (b.z + c.y)) - 4 * y * (a.x + c.z),
                  2 * (w * (b.x - a.y) + x * (a.z + c.x) + y * (b.z + c.y)) - 4 * z * (a.x + b.y)};
  const V along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int i = 0; i < 4; ++i) out[i] = p.length > V{} ? (g[i] - along * p.quaternion[i]) / p.length : V{};
}

// From the gradient of R_cam R S to those of the quaternion and the scales.
template <class T, class V>
inline void axes_backward(const Camera<T>& camera, const RowValues<V>& row, const Projection<V>& p, const Matrix<V>& v,
                          RowValues<V>& out) {
  const Vector<T>&x = camera.rotation.rows[0], &y = camera.rotation.rows[1], &z = camera.rotation.rows[2];
  Matrix<V> v_axes{{x.x * v.rows[0] + y.x * v.rows[1] + z.x * v.rows[2],
                    x.y * v.rows[0] + y.y * v.rows[1] + z.y * v.rows[2],
                    x.z * v.rows[0] + y.z * v.rows[1] + z.z * v.rows[2]}};  // R_cam^T v
  out.scales = Vector<V>{};
  for (int i = 0; i < 3; ++i) {
    const Vector<V>& r = p.world_from_gaussian.rows[i];
    Vector<V>& a = v_axes.rows[i];
    out.scales = out.scales + Vector<V>{a.x * r.x, a.y * r.y, a.z * r.z};
    a = {a.x * row.scales.x, a.y * row.scales.y, a.z * row.scales.z};
  }
  quaternion_backward(p, v_axes, out.quaternion);
}

// Gradients of the shape: fills those of quaternion and scales, answers that of the mean in the camera through J.
template <class T, class V>
inline Vector<V> shape_backward(const Camera<T>& camera, const RowValues<V>& row, const Projection<V>& p,
                                const FactorGradient<V>& g, RowValues<V>& out) {
  const Matrix<V>& m = p.camera_from_gaussian;
  const V iz = p.inverse_z, jx = camera.fx * iz, jy = camera.fy * iz;
  const Matrix<V> v_m{{jx * g.x, jy * g.y, (-jx * p.slope[0]) * g.x + (-jy * p.slope[1]) * g.y}};
  axes_backward(camera, row, p, v_m, out);

  const V v_jxx = dot(g.x, m.rows[0]), v_jxz = dot(g.x, m.rows[2]);
  const V v_jyy = dot(g.y, m.rows[1]), v_jyz = dot(g.y, m.rows[2]);
  const V x = p.inside[0] ? -jx * v_jxz * iz : V{}, y = p.inside[1] ? -jy * v_jyz * iz : V{};
  const V z = -iz * (jx * v_jxx + jy * v_jyy - jx * p.slope[0] * v_jxz - jy * p.slope[1] * v_jyz);
  return {x, y, z - x * p.slope[0] - y * p.slope[1]};
}

// Fills the gradient of the coefficients; answers that of the mean in the camera through the direction.
template <class T, class V>
inline Vector<V> color_backward(const Camera<T>& camera, const Vector<V>& in_camera, const Vector<V>& v_color,
                                const V* sh, int64_t terms, V* sh_out) {
  const ViewColor<V> c = view_color(camera, in_camera, sh, terms);
  const Vector<V> v = {c.raw.x > V{} ? v_color.x : V{}, c.raw.y > V{} ? v_color.y : V{},
                       c.raw.z > V{} ? v_color.z : V{}};
  V v_values[16];
  for (int64_t k = 0; k < terms; ++k) {
    v_values[k] = sh[3 * k] * v.x + sh[3 * k + 1] * v.y + sh[3 * k + 2] * v.z;
    sh_out[3 * k] = c.values[k] * v.x, sh_out[3 * k + 1] = c.values[k] * v.y, sh_out[3 * k + 2] = c.values[k] * v.z;
  }
  const Vector<V> v_direction = basis_backward(c.direction, terms, v_values);
  const V along = dot(v_direction, c.direction);
  return camera.rotation * ((1 / c.distance) * (v_direction + -along * c.direction));
}

// All gradients of a register of rows but that of the harmonics' coefficients. `v_mean`: of the mean in the camera,
// through the colour.
template <class T, class V>
inline RowValues<V> row_backward(const Camera<T>& camera, const RowValues<V>& row, const Projection<V>& p,
                                 const ScreenGradient<V>& g, const Vector<V>& v_mean) {
  RowValues<V> out;
  const Vector<V> v_shape = shape_backward(camera, row, p, factor_backward(camera, p, g), out);
  const V jx = camera.fx * p.inverse_z, jy = camera.fy * p.inverse_z;
  const Vector<V> v_place{g.x * jx, g.y * jy,
                          g.depth - (g.x * jx * p.in_camera.x + g.y * jy * p.in_camera.y) * p.inverse_z};
  out.mean = transposed(camera.rotation, v_shape + v_place + v_mean);
  out.opacity = g.log_opacity / row.opacity;
  return out;
}

// Typed views of the gradients.
template <class T>
struct Outputs {
  int64_t terms;
  T *means, *quaternions, *scales, *opacities, *sh, *screen;
  Outputs(const RowGradients& g, int64_t terms)
      : terms(terms), means(static_cast<T*>(g.means)), quaternions(static_cast<T*>(g.quaternions)),
        scales(static_cast<T*>(g.scales)), opacities(static_cast<T*>(g.opacities)), sh(static_cast<T*>(g.sh)),
        screen(static_cast<T*>(g.screen)) {}

  void set_zero(int64_t row) const {
    std::memset(static_cast<void*>(means + 3 * row), 0, 3 * sizeof(T));
    std::memset(static_cast<void*>(quaternions + 4 * row), 0, 4 * sizeof(T));
    std::memset(static_cast<void*>(scales + 3 * row), 0, 3 * sizeof(T));
    std::memset(static_cast<void*>(sh + 3 * terms * row), 0, 3 * terms * sizeof(T));
    std::memset(static_cast<void*>(screen + 2 * row), 0, 2 * sizeof(T));
    opacities[row] = 0;
  }
};

// Sums of the slots of rows row(0), row(1), ..., one per lane.
template <class T, class RowAt>
inline Slot<Lanes<T>> sum_slots(const Workspace<T>& ws, RowAt row) {
  constexpr int columns = SLOT_COLUMNS<T>;
  T sums[LANES<T>][columns];
  for (int lane = 0; lane < LANES<T>; ++lane) {
    const T* slots = reinterpret_cast<const T*>(&ws.slots[ws.tiles[row(lane)].first_slot]);
    for (int c = 0; c < columns; ++c) sums[lane][c] = slots[c];
    for (int32_t k = 1; k < ws.tiles[row(lane)].count; ++k)
      for (int c = 0; c < columns; ++c) sums[lane][c] += slots[k * columns + c];
  }
  Slot<Lanes<T>> sum;
  load_columns<T>([&](int lane) { return sums[lane]; }, columns, &sum.s);
  return sum;
}

// `count` visible rows, at most LANES.
template <class T>
void backward_block(const Workspace<T>& ws, const Camera<T>& camera, const Inputs<T>& in, const Outputs<T>& out,
                    const int64_t* rows, int count) {
  using V = Lanes<T>;
  const auto row = [&](int lane) { return rows[lane < count ? lane : count - 1]; };
  const int coefficients = int(3 * in.terms);
  Splat<V> splat;
  load_columns<T>([&](int r) { return reinterpret_cast<const T*>(&ws.splats[row(r)]); }, SPLAT_COLUMNS<T>, &splat.x);
  const RowValues<V> values = load_rows(in, row);
  Projection<V> p;
  place(camera, values, p);
  project_shape(camera, p);
  const ScreenGradient<V> g = screen_gradient(sum_slots(ws, row), splat);
  V sh[3 * 16], v_sh[3 * 16];
  load_columns<T>([&](int r) { return in.sh + 3 * in.terms * row(r); }, coefficients, sh);
  const Vector<V> v_mean = color_backward(camera, p.in_camera, g.color, sh, in.terms, v_sh);
  const RowValues<V> v = row_backward(camera, values, p, g, v_mean);
  store_columns<T>(&v.mean.x, 3, count, [&](int r) { return out.means + 3 * row(r); });
  store_columns<T>(v.quaternion, 4, count, [&](int r) { return out.quaternions + 4 * row(r); });
  store_columns<T>(&v.scales.x, 3, count, [&](int r) { return out.scales + 3 * row(r); });
  store_columns<T>(&v.opacity, 1, count, [&](int r) { return out.opacities + row(r); });
  store_columns<T>(v_sh, coefficients, count, [&](int r) { return out.sh + 3 * in.terms * row(r); });
  store_columns<T>(&g.abs_x, 2, count, [&](int r) { return out.screen + 2 * row(r); });
}

// Rows `range` of the input: culled ones get zeros, the others are gathered until they fill a register. In which lane
// a row is computed does not change its bits.
template <class T>
void backward_range(const Workspace<T>& ws, const Camera<T>& camera, const Inputs<T>& in, const Outputs<T>& out,
                    const Range& range) {
  int64_t rows[LANES<T>];
  int count = 0;
  for (int64_t i = range.begin; i < range.end; ++i) {
    if (ws.tiles[i].count == 0) {
      out.set_zero(i);
      continue;
    }
    rows[count++] = i;
    if (count == LANES<T>) backward_block(ws, camera, in, out, rows, count), count = 0;
  }
  if (count > 0) backward_block(ws, camera, in, out, rows, count);
}

template <class T>
void project_backward(Workspace<T>& ws, const View& view, const Rows& rows, const RowGradients& gradients) {
  const double start = omp_get_wtime();
  const Inputs<T> in(rows);
  const Outputs<T> out(gradients, in.terms);
  const Camera<T> camera(view);
#pragma omp parallel for num_threads(view.threads) schedule(static)
  for (int64_t part = 0; part < view.threads; ++part)
    backward_range(ws, camera, in, out, Range(in.count, part, view.threads));
  ws.seconds[PROJECT_BACKWARD] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
