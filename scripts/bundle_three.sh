#!/bin/sh
# Build src/objectflow/view/report_page/three.min.js from npm's packages: the parts of three.js that the report uses,
# one classic script that defines THREE. Run it again to move to another version.
set -eu
three=0.187.0
esbuild=0.28.2
target=$(cd "$(dirname "$0")/../src/objectflow/view/report_page" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm install --silent --no-save "three@$three" "esbuild@$esbuild"
cat > entry.js <<END
export {
  BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, Group, Mesh, MeshBasicMaterial,
  PerspectiveCamera, Points, PointsMaterial, Quaternion, Scene, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
END
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --target=es2022 --legal-comments=none \
  --banner:js="/* three.js $three, MIT licence, see three.LICENSE.txt */" --outfile=three.min.js
cp three.min.js "$target/three.min.js"
cp node_modules/three/LICENSE "$target/three.LICENSE.txt"
