// The sky behind an image: a cube map, looked up in the direction of each pixel through which light comes
// (ops/cube_map.py has the map's geometry).
#pragma once
#include <algorithm>
#include <cmath>

#include "interface.h"
#include "small_matrix.hpp"

namespace SPLAT_VARIANT {

using namespace splat;

// The four texels around a direction (first number of each) and their bilinear weights.
template <class T>
struct Corners {
  int64_t at[4];
  T weights[4];
  // Their mean color.
  Vector<T> mix(const T* texels) const {
    Vector<T> sum{};
    for (int i = 0; i < 4; ++i)
      sum = sum + weights[i] * Vector<T>{texels[at[i]], texels[at[i] + 1], texels[at[i] + 2]};
    return sum;
  }
};

template <class T>
struct SkyRays {
  Matrix<T> matrix;
  T half, least, most;
  int64_t width, stride;
  const int64_t* bordered;
  const T* directions;

  explicit SkyRays(const Sky& s)
      : half(T(0.5) * T(s.side)), least(T(0.5)), most(T(s.side) + T(0.5)), width(s.width), stride(s.side + 2),
        bordered(s.bordered), directions(static_cast<const T*>(s.directions)) {
    for (int i = 0; i < 3; ++i) matrix.rows[i] = {T(s.rays[3 * i]), T(s.rays[3 * i + 1]), T(s.rays[3 * i + 2])};
  }

  // Not of unit length: only where it hits the cube counts.
  Vector<T> direction(int64_t row, int64_t column) const {
    if (directions) {
      const T* d = directions + 3 * (row * width + column);
      return {d[0], d[1], d[2]};
    }
    return matrix * Vector<T>{T(column) + T(0.5), T(row) + T(0.5), T(1)};
  }

  Corners<T> corners(int64_t row, int64_t column) const {
    const Vector<T> d = direction(row, column);
    const T x = std::fabs(d.x), y = std::fabs(d.y), z = std::fabs(d.z);
    const int axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
    const T largest = axis == 0 ? d.x : axis == 1 ? d.y : d.z;
    const T scale = half / std::fabs(largest);
    const T across = inside((axis == 0 ? d.y : d.x) * scale), down = inside((axis == 2 ? d.y : d.z) * scale);
    const int64_t left = int64_t(across), top = int64_t(down);
    const T right_share = across - T(left), bottom_share = down - T(top);
    const int64_t* first = bordered + ((2 * axis + (largest < 0)) * stride + top) * stride + left;
    return {{3 * first[0], 3 * first[1], 3 * first[stride], 3 * first[stride + 1]},
            {(1 - right_share) * (1 - bottom_share), right_share * (1 - bottom_share),
             (1 - right_share) * bottom_share, right_share * bottom_share}};
  }

 private:
  // From the middle of a face to a place in the bordered one, whose texel centers are whole numbers. Whatever is no
  // number becomes the least place, so that nothing is read outside the table.
  T inside(T from_middle) const {
    const T place = from_middle + (half + T(0.5));
    return place > least ? (place < most ? place : most) : least;
  }
};

template <class T>
void over_sky(const Sky& sky, const T* rgb, const T* alpha, T* out) {
  const SkyRays<T> rays(sky);
  const T *texels = static_cast<const T*>(sky.texels), least_light = T(sky.transmittance_min);
#pragma omp parallel for num_threads(sky.threads) schedule(dynamic, 4)
  for (int64_t row = 0; row < sky.height; ++row) {
    const int64_t begin = row * sky.width;
    std::copy(rgb + 3 * begin, rgb + 3 * (begin + sky.width), out + 3 * begin);
    for (int64_t column = 0; column < sky.width; ++column) {
      const T light = T(1) - alpha[begin + column];
      if (!(light > least_light)) continue;
      const Vector<T> color = rays.corners(row, column).mix(texels);
      T* pixel = out + 3 * (begin + column);
      pixel[0] += light * color.x, pixel[1] += light * color.y, pixel[2] += light * color.z;
    }
  }
}

// Gradients of alpha [h,w] and of the texels; null: not wanted. One thread adds up the texels' in the order of pixels,
// so that it has the same bits for any number of threads.
template <class T>
void over_sky_backward(const Sky& sky, const T* alpha, const T* v_out, T* v_alpha, T* v_texels) {
  const SkyRays<T> rays(sky);
  const T *texels = static_cast<const T*>(sky.texels), least_light = T(sky.transmittance_min);
  if (v_texels) std::fill(v_texels, v_texels + 18 * sky.side * sky.side, T(0));
  for (int64_t row = 0; row < sky.height; ++row)
    for (int64_t column = 0; column < sky.width; ++column) {
      const int64_t pixel = row * sky.width + column;
      const T light = T(1) - alpha[pixel];
      if (v_alpha) v_alpha[pixel] = T(0);
      if (!(light > least_light)) continue;
      const Corners<T> corners = rays.corners(row, column);
      const Vector<T> v{v_out[3 * pixel], v_out[3 * pixel + 1], v_out[3 * pixel + 2]};
      if (v_alpha) v_alpha[pixel] = -dot(v, corners.mix(texels));
      if (!v_texels) continue;
      for (int i = 0; i < 4; ++i) {
        const Vector<T> share = light * corners.weights[i] * v;
        T* to = v_texels + corners.at[i];
        to[0] += share.x, to[1] += share.y, to[2] += share.z;
      }
    }
}

}  // namespace SPLAT_VARIANT
