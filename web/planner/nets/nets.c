/* Dense layers with WebAssembly's 128-bit vectors: y = activation(W x + b), many rows at once.

Reads weights packed by nets.js: for each 8 outputs, the 8 weights of each input in turn. Four rows
and eight outputs are worked on together, whose sums stay in registers. */

#include <wasm_simd128.h>

#define EXPORT(name) __attribute__((export_name(#name))) name
#define ADD_MUL(sum, x, w) sum = wasm_f32x4_add(sum, wasm_f32x4_mul(x, w))

enum { NONE, ELU, TANH };

extern unsigned char __heap_base;

/* Where JavaScript may lay its numbers. */
unsigned char *EXPORT(free_from)(void) { return &__heap_base; }

/* Return e^x to about 1e-7: 2^n times a polynomial (Taylor's) of the rest, at most ln(2) / 2. */
static v128_t exponential(v128_t x) {
  x = wasm_f32x4_min(wasm_f32x4_max(x, wasm_f32x4_splat(-87.0f)), wasm_f32x4_splat(88.0f));
  v128_t n = wasm_f32x4_nearest(wasm_f32x4_mul(x, wasm_f32x4_splat(1.44269504f)));
  /* ln(2) in two parts, so that n times the first is exact. */
  v128_t r = wasm_f32x4_sub(x, wasm_f32x4_mul(n, wasm_f32x4_splat(0.693359375f)));
  r = wasm_f32x4_add(r, wasm_f32x4_mul(n, wasm_f32x4_splat(2.12194440e-4f)));
  v128_t sum = wasm_f32x4_splat(1.0f / 5040);
  const float terms[] = {1.0f / 720, 1.0f / 120, 1.0f / 24, 1.0f / 6, 0.5f, 1.0f, 1.0f};
  for (int i = 0; i < 7; i++)
    sum = wasm_f32x4_add(wasm_f32x4_mul(sum, r), wasm_f32x4_splat(terms[i]));
  v128_t power = wasm_i32x4_add(wasm_i32x4_trunc_sat_f32x4(n), wasm_i32x4_splat(127));
  return wasm_f32x4_mul(sum, wasm_i32x4_shl(power, 23));
}

static v128_t activated(v128_t x, int activation) {
  v128_t one = wasm_f32x4_splat(1.0f);
  if (activation == ELU) {
    v128_t below = wasm_f32x4_sub(exponential(x), one);
    return wasm_v128_bitselect(x, below, wasm_f32x4_gt(x, wasm_f32x4_splat(0.0f)));
  }
  if (activation == TANH) {
    v128_t twice = exponential(wasm_f32x4_add(x, x));
    return wasm_f32x4_sub(one, wasm_f32x4_div(wasm_f32x4_splat(2.0f), wasm_f32x4_add(one, twice)));
  }
  return x;
}

/* `rows` is a multiple of 4, `outputs` of 8. */
void EXPORT(dense)(const float *x, int rows, int inputs, const float *weights, const float *bias,
                   int outputs, float *y, int activation) {
  for (int o = 0; o < outputs; o += 8) {
    const float *packed = weights + o * inputs;
    v128_t low = wasm_v128_load(bias + o), high = wasm_v128_load(bias + o + 4);
    for (int r = 0; r < rows; r += 4) {
      const float *x0 = x + r * inputs, *x1 = x0 + inputs, *x2 = x1 + inputs, *x3 = x2 + inputs;
      v128_t a0 = low, a1 = low, a2 = low, a3 = low, b0 = high, b1 = high, b2 = high, b3 = high;
      for (int k = 0; k < inputs; k++) {
        v128_t w = wasm_v128_load(packed + 8 * k), v = wasm_v128_load(packed + 8 * k + 4);
        v128_t s = wasm_v128_load32_splat(x0 + k), t = wasm_v128_load32_splat(x1 + k);
        ADD_MUL(a0, s, w);
        ADD_MUL(b0, s, v);
        ADD_MUL(a1, t, w);
        ADD_MUL(b1, t, v);
        s = wasm_v128_load32_splat(x2 + k), t = wasm_v128_load32_splat(x3 + k);
        ADD_MUL(a2, s, w);
        ADD_MUL(b2, s, v);
        ADD_MUL(a3, t, w);
        ADD_MUL(b3, t, v);
      }
      const v128_t sums[] = {a0, b0, a1, b1, a2, b2, a3, b3};
      for (int i = 0; i < 8; i++)
        wasm_v128_store(y + (r + i / 2) * outputs + o + 4 * (i % 2), activated(sums[i], activation));
    }
  }
}
